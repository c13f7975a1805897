"""Tight capacities: packed where a packing is there, infeasible only where it is proven that there is none."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from flockopt import Bounds, Drone, Scene, Task, plan, refine_bundles
from flockopt.bundles import packing
from flockopt.bundles.explain import NOT_FOUND, explained
from flockopt.bundles.packing import pack
from flockopt.travel.travel import straight_travel


def fleet(capacities, demands, **limits):
    rng = np.random.default_rng(len(demands))
    drones = tuple(Drone(f"d{i}", (1.0 + i, 1, 1), int(c), 0.1, 2, 4, 30, **limits) for i, c in enumerate(capacities))
    tasks = tuple(
        Task(f"t{j}", (float(x), float(y), 2.0), int(demand))
        for j, (demand, (x, y)) in enumerate(zip(demands, rng.uniform(4, 29, (len(demands), 2)), strict=True))
    )
    return Scene("packing", Bounds((0, 0, 0), (30, 30, 5)), drones, tasks)


def exact_fit(drones, each, seed):
    parts = np.random.default_rng(seed).integers(20, 200, (drones, each))
    return fleet(parts.sum(axis=1), parts.ravel())


def is_packable(scene):
    return any(
        all(scene.demands[np.array(chosen) == i].sum() <= scene.capacities[i] for i in range(scene.num_drones))
        for chosen in itertools.product(range(scene.num_drones), repeat=scene.num_tasks)
    )


@pytest.mark.parametrize("seed", range(40))
def test_small_packings_are_found_or_refuted(seed):
    rng = np.random.default_rng(seed)
    scene = fleet(rng.integers(4, 12, 3), rng.integers(1, 8, 6))
    found = pack(scene, straight_travel(scene), thorough=False)
    assert found.is_impossible != is_packable(scene)
    if found.drones is not None:
        loads = np.bincount(found.drones, scene.demands, scene.num_drones)
        assert (loads <= scene.capacities).all()


@pytest.mark.parametrize(("drones", "each"), [(3, 3), (4, 4), (6, 3)])
def test_fleets_that_are_filled_to_the_last_unit_are_planned(drones, each):
    for seed in range(3):
        bundles = refine_bundles(exact_fit(drones, each, seed))
        assert bundles.status == "feasible"
        assert not bundles.unserved


def test_what_cannot_be_packed_is_proven():
    scene = fleet([101] * 6, [34] * 17 + [1])  # enough in sum, and two in each drone at most
    made = plan(scene, planner="classical")
    assert made.status == "infeasible"
    assert "that is proven" in made.reason


def test_what_is_only_not_found_is_said_so(monkeypatch):
    monkeypatch.setattr(packing, "MOST_CHOICES", 1)
    monkeypatch.setattr(packing, "_by_cp_sat", lambda *_: None)
    scene = fleet([101] * 6, [34] * 17 + [1])
    made = plan(scene, planner="classical")
    assert made.status == "uncertified"
    assert made.reason.startswith(NOT_FOUND)
    assert [clause.name for clause in made.certificate.failed] == ["coverage"]
    assert made.unserved and made.flights and made.cost.lower_bound is None


def test_a_range_that_is_too_short_for_what_was_found_proves_nothing():
    scene = fleet([9, 9], [1, 1], max_distance=60.0)
    bundles = explained(scene, straight_travel(scene), ((0,), ()))
    assert bundles.status == "incomplete"
    assert bundles.reason.startswith(NOT_FOUND)
