"""The transport polytope: primal, dual and rounding."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from flockopt import MissingExtra, SettingsError
from flockopt.bundles.assignment import transport
from flockopt.bundles.refine import refine_bundles
from tests.instances import random_scene


def case(seed: int, **settings):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, drones=4, tasks=9, **({"capacity": 3} | settings))
    return scene, rng.random((4, 9))


@pytest.mark.parametrize("seed", range(8))
def test_clarabel_and_the_fast_path_agree_and_their_duals_prove_it(seed: int):
    scene, preferences = case(seed)
    fast, slow = transport(scene, preferences, solver="scipy"), transport(scene, preferences, solver="clarabel")
    assert (fast.assignment == slow.assignment).all()
    for answer, tolerance in ((fast, 1e-9), (slow, 1e-6)):
        assert abs(answer.residuals.gap) <= tolerance
        assert answer.residuals.primal <= 1e-6
        reduced = answer.task_prices + answer.drone_prices[:, None] * scene.demands - preferences
        assert reduced.min() >= -1e-9
        assert answer.assignment.sum(axis=0).tolist() == [1] * 9
        assert (answer.assignment.sum(axis=1) <= scene.capacities).all()


@pytest.mark.parametrize("seed", range(6))
def test_heavier_tasks_are_rounded_within_capacity(seed: int):
    scene, preferences = case(seed, capacity=6, demands=True)
    answer = transport(scene, preferences)
    assert abs(answer.residuals.gap) <= 1e-6
    assert (answer.assignment @ scene.demands <= scene.capacities).all()
    assert (answer.assignment.sum(axis=0) <= 1).all()
    assert (preferences * answer.assignment).sum() <= (preferences * answer.primal).sum() + 1e-6


def test_too_little_capacity_leaves_tasks_out():
    scene, preferences = case(0, capacity=2)
    answer = transport(scene, preferences)
    assert answer.assignment.sum() == 8
    assert abs(answer.residuals.gap) <= 1e-9


def test_eight_threads_get_what_one_gets():
    """A problem is built once per size and written into by every solve."""
    scenes = [case(seed, capacity=6, demands=True) for seed in range(4)] * 4
    alone = [refine_bundles(scene, preferences, method="lp").routes for scene, preferences in scenes]
    with ThreadPoolExecutor(8) as threads:
        together = threads.map(lambda one: refine_bundles(*one, method="lp").routes, scenes)
        assert list(together) == alone
    assert len(set(alone)) == 4


def test_bad_settings_and_a_missing_solver(monkeypatch):
    scene, preferences = case(0, capacity=6, demands=True)
    with pytest.raises(SettingsError, match="solver is 'simplex'"):
        transport(scene, preferences, solver="simplex")
    with pytest.raises(SettingsError, match="serves unit demands only"):
        transport(scene, preferences, solver="scipy")
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(MissingExtra, match=r"cvxpy.*solvers"):
        transport(scene, preferences)
