"""`refine_bundles`: the optimum on small scenes, reasons where there is none, and named errors."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from flockopt import Bounds, Bundles, Drone, Scene, SettingsError, Task, refine_bundles
from flockopt.travel.travel import straight_travel
from tests.instances import random_instance, random_scene, with_cut_legs
from tests.known.brute_force import least_travel

SPACE = Bounds((0.0, 0.0, 0.0), (100.0, 100.0, 5.0))


def drone(number: int, x: float, capacity: int = 9, **more) -> Drone:
    return Drone(f"d{number}", (x, 50.0, 1.0), capacity, 0.12, 2.0, 4.0, 30.0, **more)


def task(number: int, x: float, demand: int = 1) -> Task:
    return Task(f"t{number}", (x, 50.0, 1.0), demand)


def line(drones: list[Drone], tasks: list[Task]) -> Scene:
    return Scene("line", SPACE, tuple(drones), tuple(tasks))


def refined(scene: Scene, *arguments, **settings) -> Bundles:
    return refine_bundles(scene, *arguments, travel=straight_travel(scene), **settings)


def keeps_every_limit(scene: Scene, travel, bundles: Bundles) -> bool:
    served = [j for route in bundles for j in route]
    left = [j for j, _ in bundles.unserved]
    assert sorted(served + left) == list(range(scene.num_tasks))
    for i, route in enumerate(bundles):
        assert scene.demands[list(route)].sum() <= scene.capacities[i]
        if route:
            limit = scene.drones[i].max_distance
            assert travel.route_length(i, route) <= (math.inf if limit is None else limit + 1e-9)
    return True


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("plain", {"capacity": 3}),
        ("uneven capacities", {"capacity": [1, 2, 4]}),
        ("demands", {"capacity": 5, "demands": True}),
        ("ends", {"capacity": 3, "ends": True}),
        ("reach", {"capacity": 4, "ends": True, "max_distance": 30.0}),
        ("everything", {"capacity": [2, 5, 7], "ends": True, "demands": True, "max_distance": 45.0}),
    ],
)
def test_small_scenes_are_solved_to_the_optimum(name, settings):
    rng = np.random.default_rng(len(name))
    feasible = 0
    for _ in range(25):
        scene, travel = random_instance(rng, drones=3, tasks=int(rng.integers(1, 8)), **settings)
        bundles, least = refine_bundles(scene, travel=travel), least_travel(scene, travel)
        assert keeps_every_limit(scene, travel, bundles)
        if math.isinf(least):
            assert bundles.status in ("infeasible", "incomplete")  # no proof covers every mix of capacities and reaches
            assert bundles.reason
        else:
            feasible += 1
            assert bundles.status == "feasible"
            assert travel.total(bundles.routes) == pytest.approx(least, abs=1e-9)
    assert feasible >= 10


def test_legs_without_a_way_are_not_flown():
    rng = np.random.default_rng(3)
    feasible = 0
    for _ in range(40):
        scene, travel = random_instance(rng, drones=3, tasks=6, capacity=4)
        travel = with_cut_legs(rng, travel, 0.4)
        bundles, least = refine_bundles(scene, travel=travel), least_travel(scene, travel)
        assert math.isfinite(travel.total(bundles.routes))
        assert (bundles.status == "feasible") == math.isfinite(least)
        if math.isfinite(least):
            feasible += 1
            assert travel.total(bundles.routes) == pytest.approx(least, abs=1e-9)
    assert 5 <= feasible < 40


def test_drones_of_different_classes_use_their_own_matrix():
    rng = np.random.default_rng(8)
    for _ in range(15):
        scene, travel = random_instance(rng, drones=3, tasks=6, capacity=3)
        slow = travel.task_task * rng.uniform(1.0, 2.0)
        both = np.concatenate([travel.task_task, slow])
        travel = dataclasses.replace(travel, task_task=both, drone_class=np.array([0, 1, 0]))
        assert travel.total(refine_bundles(scene, travel=travel).routes) == pytest.approx(least_travel(scene, travel))


def test_no_tasks_leave_everyone_where_they_are():
    bundles = refined(line([drone(0, 1.0), drone(1, 9.0)], []))
    assert bundles.routes == ((), ())
    assert bundles.status == "feasible"


def test_too_little_capacity_names_the_shortage_and_serves_what_fits():
    scene = line([drone(0, 0.0, capacity=2)], [task(0, 10.0), task(1, 20.0), task(2, 90.0)])
    bundles = refined(scene)
    assert bundles.status == "infeasible"
    assert bundles.routes == ((0, 1),)
    assert "demand 3" in bundles.reason
    assert "1 too little" in bundles.reason
    assert bundles.unserved == ((2, "task 't2' is left over; the fleet is full"),)


def test_a_task_heavier_than_any_capacity_is_named():
    scene = line([drone(0, 0.0, capacity=3), drone(1, 5.0, capacity=3)], [task(0, 10.0), task(1, 20.0, demand=4)])
    bundles = refined(scene)
    assert bundles.routes[0] + bundles.routes[1] == (0,)
    assert "task 't1' demands 4, more than any capacity (3)" in bundles.reason


def test_a_task_beyond_every_reach_is_named_with_its_distance():
    scene = line([drone(0, 0.0, max_distance=30.0)], [task(0, 10.0), task(1, 80.0)])
    bundles = refined(scene)
    assert bundles.routes == ((0,),)
    assert "task 't1' is too far for every drone's max_distance (at least 80 m)" in bundles.reason


def test_a_task_walled_in_is_named():
    scene = line([drone(0, 0.0), drone(1, 5.0)], [task(0, 10.0), task(1, 20.0)])
    travel = straight_travel(scene)
    cut = travel.task_task.copy()
    cut[0, 0, 1] = cut[0, 1, 0] = np.inf
    starts = np.where([False, True], np.inf, travel.start_task)
    bundles = refine_bundles(scene, travel=dataclasses.replace(travel, start_task=starts, task_task=cut))
    assert bundles.routes == ((), (0,))
    assert "task 't1' cannot be reached" in bundles.reason


def test_a_drone_that_cannot_reach_its_end_is_named():
    scene = line([drone(0, 0.0, end=(90.0, 50.0, 1.0), max_distance=50.0), drone(1, 5.0)], [task(0, 10.0)])
    bundles = refined(scene)
    assert bundles.routes == ((), (0,))
    assert bundles.status == "infeasible"
    assert "drone 'd0' is 90 m from its end and its max_distance is 50" in bundles.reason


def test_a_limit_just_met_is_met():
    scene = line([drone(0, 0.0, max_distance=30.0)], [task(0, 10.1), task(1, 20.2), task(2, 30.0)])
    assert refined(scene).status == "feasible"


def test_equal_seeds_and_iterations_give_equal_bundles():
    scene = random_scene(np.random.default_rng(5), drones=6, tasks=30, capacity=6)
    assert refined(scene, iterations=300, seed=4) == refined(scene, iterations=300, seed=4)
    assert len({refined(scene, iterations=20, seed=seed).routes for seed in range(6)}) > 1


def test_more_iterations_cost_no_more_than_none():
    scene = random_scene(np.random.default_rng(6), drones=6, tasks=40, capacity=8)
    travel = straight_travel(scene)
    greedy, searched = (travel.total(refined(scene, iterations=count).routes) for count in (0, 3000))
    assert searched < 0.99 * greedy


def test_preferences_steer_the_first_solution_and_travel_decides_the_last():
    scene = line([drone(0, 10.0), drone(1, 90.0)], [task(0, 20.0), task(1, 80.0)])
    crossed = [[0.0, 1.0], [1.0, 0.0]]
    assert refined(scene, crossed, iterations=0).routes == ((1,), (0,))
    assert refined(scene, crossed).routes == ((0,), (1,))


def test_a_warm_start_is_kept_where_nothing_is_better():
    scene = random_scene(np.random.default_rng(7), drones=5, tasks=30, capacity=7)
    best = refined(scene, iterations=4000)
    assert refined(scene, warm_start=best, iterations=0).routes == best.routes
    travel = straight_travel(scene)
    assert travel.total(refined(scene, warm_start=best, iterations=50).routes) <= travel.total(best.routes)


def test_a_warm_start_that_breaks_capacity_is_mended():
    scene = line([drone(0, 0.0, capacity=1), drone(1, 90.0, capacity=2)], [task(0, 10.0), task(1, 20.0), task(2, 80.0)])
    bundles = refined(scene, warm_start=[(0, 1, 2), ()])
    assert bundles.status == "feasible"
    assert bundles.routes == ((0,), (2, 1))


@pytest.mark.parametrize(
    ("settings", "field", "value"),
    [
        ({"task_probs": [[0.5, 0.5]]}, "task_probs", r"shape \(1, 2\)"),
        ({"task_probs": [[0.5, math.nan], [0.5, 0.5]]}, r"task_probs\[0\]\[1\]", "nan"),
        ({"task_probs": [[0.5, 0.5], [-0.25, 0.5]]}, r"task_probs\[1\]\[0\]", "-0.25"),
        ({"task_probs": [[0.5, 0.5], [0.5, math.inf]]}, r"task_probs\[1\]\[1\]", "inf"),
        ({"task_probs": "half"}, "task_probs", "not an array"),
        ({"task_probs": [[0.5], [0.5, 0.5]]}, "task_probs", "not an array"),
        ({"method": "oracle"}, "method", "'oracle'"),
        ({"iterations": -1}, "iterations", "-1"),
        ({"iterations": 1.5}, "iterations", "1.5"),
        ({"time_limit_s": 0.0}, "time_limit_s", "0.0"),
        ({"time_limit_s": math.nan}, "time_limit_s", "nan"),
        ({"seed": -3}, "seed", "-3"),
        ({"warm_start": [(0,)]}, "warm_start", "1 routes"),
        ({"warm_start": [(0,), (0,)]}, r"warm_start\[1\]\[0\]", "is 0"),
        ({"warm_start": [(0, 2), ()]}, r"warm_start\[0\]\[1\]", "is 2"),
    ],
)
def test_bad_arguments_are_named(settings, field, value):
    scene = line([drone(0, 0.0), drone(1, 9.0)], [task(0, 10.0), task(1, 20.0)])
    with pytest.raises(SettingsError, match=f"^{field} .*{value}"):
        refined(scene, **settings)


def test_an_unknown_method_lists_the_known_ones():
    with pytest.raises(SettingsError, match="search, lp, cvrp, exact"):
        refined(line([drone(0, 0.0)], []), method="magic")
