"""Labels over ng-routes against a plain enumeration of them, and the ascent that uses them."""

import math

import numpy as np
import pytest

from flockopt.bundles.bounds.ng_route import neighbourhood
from flockopt.bundles.bounds.pricing import ascend_prices, evaluate, group_drones
from flockopt.travel import Travel
from tests.instances import random_instance


def cheapest_ng_route(scene, travel, drone, prices, size):
    """The least of length less prices over all walks from ``drone`` that ng-memory and capacity allow."""
    between = travel.task_task[travel.drone_class[drone]]
    num = len(between)
    ranked = [sorted(range(num), key=lambda k, j=j: (k != j, between[j, k], k))[:size] for j in range(num)]

    def extended(task, memory, load, cost):
        best = cost + travel.task_end[drone, task]
        for after in range(num):
            heavier = load + scene.tasks[after].demand
            if after not in memory and heavier <= scene.drones[drone].capacity:
                kept = (memory & set(ranked[after])) | {after}
                best = min(best, extended(after, kept, heavier, cost + between[task, after] - prices[after]))
        return best

    routes = [
        extended(task, {task}, scene.tasks[task].demand, travel.start_task[drone, task] - prices[task])
        for task in range(num)
        if scene.tasks[task].demand <= scene.drones[drone].capacity
    ]
    return min([travel.start_end[drone], *routes])


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", range(6))
def test_evaluate_finds_every_drones_cheapest_ng_route(seed, size):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=3, tasks=5, capacity=4, ends=seed % 2 == 0, demands=seed % 3 == 0)
    prices = rng.uniform(0, 12, 5)
    expected = prices.sum() + sum(cheapest_ng_route(scene, travel, drone, prices, size) for drone in range(3))
    value, _ = evaluate(group_drones(scene, travel, size), prices)
    assert value == pytest.approx(expected, rel=1e-12)


def test_drones_with_one_matrix_and_one_end_share_labels():
    scene, travel = random_instance(np.random.default_rng(0), drones=4, tasks=5, capacity=3)
    assert [list(group.drones) for group in group_drones(scene, travel)] == [[0, 1, 2, 3]]
    travel = Travel(
        travel.start_task, np.repeat(travel.task_task, 2, 0), travel.task_end, travel.start_end, np.array([0, 1, 0, 1])
    )
    assert [list(group.drones) for group in group_drones(scene, travel)] == [[0, 2], [1, 3]]


def test_visits_are_the_subgradient():
    rng = np.random.default_rng(3)
    scene, travel = random_instance(rng, drones=3, tasks=8, capacity=3)
    groups, prices = group_drones(scene, travel), rng.uniform(1, 6, 8)
    value, visits = evaluate(groups, prices)
    for other in rng.uniform(0, 9, (20, 8)):
        # The bound is concave in the prices, so it lies below each of its tangents.
        assert evaluate(groups, other)[0] <= value + (1 - visits) @ (other - prices) + 1e-9


def test_the_ascent_never_ends_below_its_start():
    rng = np.random.default_rng(5)
    scene, travel = random_instance(rng, drones=3, tasks=9, capacity=4)
    groups, prices = group_drones(scene, travel), rng.uniform(0, 5, 9)
    better = ascend_prices(groups, prices, rounds=30, upper=math.inf)
    assert (better >= 0).all()
    assert evaluate(groups, better)[0] > evaluate(groups, prices)[0]


def test_no_tasks_cost_what_idle_drones_fly():
    scene, travel = random_instance(np.random.default_rng(1), drones=2, tasks=0, capacity=1, ends=True)
    assert evaluate(group_drones(scene, travel), np.empty(0))[0] == pytest.approx(travel.start_end.sum())


def test_neighbours_are_ranked_by_distance_then_index_with_the_task_itself_first():
    between = np.array([[0.0, 0.0, 2.0, 1.0], [0.0, 0.0, 2.0, 2.0], [2.0, 2.0, 0.0, 1.0], [1.0, 2.0, 1.0, 0.0]])
    near = neighbourhood(between, 3)
    assert near.nearest.tolist() == [[1, 3], [0, 2], [3, 0], [0, 2]]
    assert near.position[0].tolist() == [-1, 0, -1, 1]
    # Task 3 stands first in the row of 2 and second in the row of 0.
    assert near.carried[2, 0].tolist() == [1, -1]
