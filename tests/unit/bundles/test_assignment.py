"""The transport polytope and the predecessor arcs: primal, dual and rounding."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from flockopt import MissingExtra, SettingsError
from flockopt.bundles.assignment import predecessor_arcs, transport
from flockopt.bundles.exact.exact import solve_exact
from flockopt.travel.travel import straight_travel
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


@pytest.mark.parametrize("seed", range(6))
def test_predecessor_arcs_bound_the_optimum_and_both_solvers_agree(seed: int):
    scene, _ = case(seed)
    travel = straight_travel(scene)
    fast, slow = predecessor_arcs(scene, travel), predecessor_arcs(scene, travel, solver="clarabel")
    assert fast.value == pytest.approx(slow.value, abs=1e-5)
    assert abs(fast.residuals.gap) <= 1e-9
    assert fast.value <= travel.total(solve_exact(scene, travel).bundles.routes) + 1e-9


def test_any_prices_prove_a_bound():
    scene, _ = case(1)
    travel = straight_travel(scene)
    best = travel.total(solve_exact(scene, travel).bundles.routes)
    costs = np.vstack([travel.start_task, travel.task_task[0] + np.diag(np.full(9, np.inf))])
    for seed in range(50):
        prices = np.random.default_rng(seed).exponential(2.0, 13)
        assert (costs + prices[:, None]).min(axis=0).sum() - prices.sum() <= best


def test_bad_settings_and_a_missing_solver(monkeypatch):
    scene, preferences = case(0, capacity=6, demands=True)
    with pytest.raises(SettingsError, match="solver is 'simplex'"):
        transport(scene, preferences, solver="simplex")
    with pytest.raises(SettingsError, match="serves unit demands only"):
        transport(scene, preferences, solver="scipy")
    with pytest.raises(SettingsError, match="solver is 'auto'"):
        predecessor_arcs(scene, straight_travel(scene), solver="auto")
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(MissingExtra, match=r"cvxpy.*solvers"):
        transport(scene, preferences)
