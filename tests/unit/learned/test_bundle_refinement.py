"""Vectorised bundle refinement: local optima by brute force, and every limit kept."""

from __future__ import annotations

import dataclasses
from itertools import combinations, product

import numpy as np
import pytest

from flockopt.travel.travel import straight_travel
from tests.instances import random_instance, random_scene

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.teacher.refinement import refine  # noqa: E402 - torch may be missing

TOLERANCE_M = 0.01


def fleet(seed, drones=4, tasks=9):
    """Two classes of drones, demands, ends and longest routes, and random bundles that keep all limits."""
    rng = np.random.default_rng(seed)
    longest = 70.0 if seed % 2 else None
    scene = random_scene(rng, drones=drones, tasks=tasks, capacity=7, ends=True, demands=True, max_distance=longest)
    travel = straight_travel(scene)
    matrices = np.concatenate([travel.task_task, 1.2 * travel.task_task])
    travel = dataclasses.replace(travel, task_task=matrices, drone_class=rng.integers(0, 2, drones))
    routes = [[] for _ in range(drones)]
    for task in rng.permutation(tasks):
        for drone in rng.permutation(drones):
            if keeps_limits(scene, travel, drone, [*routes[drone], int(task)]):
                routes[drone].append(int(task))
                break
    return scene, travel, routes


def keeps_limits(scene, travel, drone, route):
    limit = scene.drones[drone].max_distance
    load = sum(scene.tasks[task].demand for task in route)
    return load <= scene.drones[drone].capacity and (limit is None or travel.route_length(drone, route) <= limit + 1e-3)


def neighbours(travel, routes):
    """All routes that one transfer, one exchange of tasks, or one exchange of tails away."""
    places = [(drone, rank) for drone, route in enumerate(routes) for rank in range(len(route))]
    for drone, rank in places:
        without = [list(route) for route in routes]
        task = without[drone].pop(rank)
        for other in range(len(routes)):
            for gap in range(len(without[other]) + 1):
                yield [[*r[:gap], task, *r[gap:]] if i == other else r for i, r in enumerate(without)]
    for (drone, rank), (other, place) in combinations(places, 2):
        swapped = [list(route) for route in routes]
        swapped[drone][rank], swapped[other][place] = routes[other][place], routes[drone][rank]
        yield swapped
    for one, other in combinations(range(len(routes)), 2):
        if travel.drone_class[one] == travel.drone_class[other]:
            for gap, place in product(range(len(routes[one]) + 1), range(len(routes[other]) + 1)):
                crossed = [list(route) for route in routes]
                crossed[one] = [*routes[one][:gap], *routes[other][place:]]
                crossed[other] = [*routes[other][:place], *routes[one][gap:]]
                yield crossed


@pytest.mark.parametrize("seed", range(12))
def test_no_single_move_makes_a_refined_fleet_better(seed):
    scene, travel, routes = fleet(seed)
    (refined,) = refine([scene], [travel], [routes])
    assert sorted(task for route in refined for task in route) == sorted(task for route in routes for task in route)
    assert all(keeps_limits(scene, travel, drone, route) for drone, route in enumerate(refined))
    assert travel.total(refined) < travel.total(routes)
    best = min(
        travel.total(other)
        for other in neighbours(travel, [list(route) for route in refined])
        if all(keeps_limits(scene, travel, drone, route) for drone, route in enumerate(other))
    )
    assert travel.total(refined) <= best + TOLERANCE_M


def test_batches_of_different_sizes_are_refined_as_alone():
    fleets = [fleet(seed, drones, tasks) for seed, drones, tasks in ((1, 3, 6), (2, 5, 11), (3, 1, 4))]
    together = refine(*zip(*fleets, strict=True))
    for (scene, travel, routes), refined in zip(fleets, together, strict=True):
        assert refine([scene], [travel], [routes]) == [refined]


def test_tasks_that_are_not_served_stay_so():
    scene, travel = random_instance(np.random.default_rng(0), drones=2, tasks=6, capacity=6)
    (refined,) = refine([scene], [travel], [[[3, 1], [0]]])
    assert sorted(task for route in refined for task in route) == [0, 1, 3]


def test_scenes_without_tasks_have_empty_bundles():
    scene, travel = random_instance(np.random.default_rng(0), drones=2, tasks=0, capacity=6)
    assert refine([scene], [travel], [[[], []]]) == [((), ())]
