"""The audit: random scenes hold, and what is broken between a plan's samples is refuted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import audit
from flockopt import SceneError, plan
from flockopt.flights import Curve, Flight, Visit
from tests.flights import drone, make_scene


def scene_of(seed):
    rng = np.random.default_rng([seed, 23])
    while True:
        try:
            return audit.random_scene(rng)
        except SceneError:
            continue


@pytest.mark.parametrize("seed", [2, 5, 16, 26, 27, 30, 80])  # drones in motion, and one that is in the way of another's end
def test_random_scenes_are_certified_and_not_refuted(seed):
    scene = scene_of(seed)
    made = plan(scene, planner="classical", seed=seed)
    assert made.status == "certified"
    assert audit.refutations(scene, made, step_s=2e-3) == []


@pytest.fixture(scope="module")
def flown():
    scene = make_scene([drone(0, (1, 1, 1), max_distance=20.0), drone(1, (1, 3, 1), end="start")], [(8, 1, 1), (8, 3, 1)])
    return scene, plan(scene, planner="classical")


def with_flight(made, name, change):
    flight = made.flights[name]
    return replace(made, flights=made.flights | {name: change(flight)})


def moved(flight, by):
    coefficients = flight.curve.coefficients.copy()
    coefficients[:, :, 0] += by
    return Flight(Curve(flight.curve.breakpoints, coefficients), flight.visits)


def test_what_is_broken_is_refuted(flown):
    scene, made = flown
    first = next(iter(made.flights))
    assert audit.refutations(scene, made, step_s=2e-3) == []
    low = audit.refutations(scene, with_flight(made, first, lambda flight: moved(flight, [0.0, 0.0, -1.5])), step_s=2e-3)
    assert any("leaves the bounds" in words for words in low) and any("start state" in words for words in low)
    fast = with_flight(made, first, lambda flight: Flight(flight.curve.stretched(0.5), flight.visits))
    assert any("breaks its max_speed" in words for words in audit.refutations(scene, fast, step_s=2e-3))
    early = with_flight(
        made, first, lambda flight: Flight(flight.curve, tuple(Visit(visit.task, 0.0) for visit in flight.visits))
    )
    assert any("is not at" in words for words in audit.refutations(scene, early, step_s=2e-3))
    nobody = replace(made, routes={})
    assert "not every task is served once" in audit.refutations(scene, nobody, step_s=2e-3)


def test_the_audit_writes_a_row_a_scene(tmp_path):
    assert audit.main(["--scenes", "3", "--seed", "5", "--out", str(tmp_path)]) == 0
    assert len((tmp_path / "audit.csv").read_text(encoding="utf-8").splitlines()) == 4
