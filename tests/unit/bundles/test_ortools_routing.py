"""OR-Tools routing, the order of one drone's tasks, and `refine_bundles` by every method."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest

from flockopt import MissingExtra, refine_bundles
from flockopt.bundles.ortools_routing import NO_WAY, UNITS_PER_METRE, in_units
from flockopt.bundles.tour import shortest_order
from flockopt.travel.travel import straight_travel
from tests.instances import random_scene


def case(seed: int, **settings):
    scene = random_scene(np.random.default_rng(seed), drones=3, tasks=8, **({"capacity": 4} | settings))
    return scene, straight_travel(scene)


def test_units_round_up_and_mark_what_has_no_way():
    metres = np.array([0.0, 1.0, 1.00001, np.inf])
    assert in_units(metres).tolist() == [0, UNITS_PER_METRE, UNITS_PER_METRE + 1, NO_WAY]


@pytest.mark.parametrize("settings", [{}, {"capacity": 7, "demands": True}, {"ends": True}, {"capacity": [1, 3, 8]}])
@pytest.mark.parametrize("seed", range(3))
def test_routing_comes_near_the_optimum(seed: int, settings: dict):
    scene, travel = case(seed, **settings)
    best = refine_bundles(scene, travel=travel, method="exact")
    found = refine_bundles(scene, travel=travel, method="cvrp", iterations=80)
    assert best.status == "optimal"
    assert found.status == "feasible"
    assert travel.total(best.routes) - 1e-9 <= travel.total(found.routes) <= 1.1 * travel.total(best.routes)
    loads = [scene.demands[list(route)].sum() for route in found]
    assert (loads <= scene.capacities).all()


def test_routing_keeps_the_longest_distance():
    scene, travel = case(4, max_distance=14.0)
    found = refine_bundles(scene, travel=travel, method="cvrp", iterations=40)
    assert all(travel.route_length(drone, route) <= 14.0 for drone, route in enumerate(found))


def test_routing_names_what_does_not_fit():
    scene, travel = case(5, capacity=2)
    found = refine_bundles(scene, travel=travel, method="cvrp", iterations=40)
    assert found.status == "infeasible"
    assert len(found.unserved) == 2
    assert "2 too little" in found.reason


def test_routing_begins_with_given_routes():
    scene, travel = case(6)
    best = refine_bundles(scene, travel=travel, method="exact")
    again = refine_bundles(scene, travel=travel, method="cvrp", iterations=1, warm_start=best)
    assert travel.total(again.routes) == pytest.approx(travel.total(best.routes))


@pytest.mark.parametrize("seed", range(4))
def test_a_short_order_is_nearly_the_shortest(seed: int):
    _, travel = case(seed, ends=True)
    tasks = range(6)
    best = min(travel.route_length(1, order) for order in itertools.permutations(tasks))
    assert best - 1e-9 <= travel.route_length(1, shortest_order(travel, 1, tasks)) <= 1.15 * best
    assert shortest_order(travel, 1, ()) == ()


def test_the_assignment_follows_preferences():
    scene, travel = case(7)
    wanted = np.zeros((3, 8))
    wanted[[0, 0, 0, 1, 1, 2, 2, 2], range(8)] = 1.0
    bundles = refine_bundles(scene, wanted, travel=travel, method="lp")
    assert [set(route) for route in bundles] == [{0, 1, 2}, {3, 4}, {5, 6, 7}]


def test_without_or_tools_the_extra_is_named(monkeypatch):
    scene, travel = case(0)
    monkeypatch.setitem(sys.modules, "ortools.constraint_solver.pywrapcp", None)
    with pytest.raises(MissingExtra, match=r"ortools.*solvers"):
        refine_bundles(scene, travel=travel, method="cvrp")
