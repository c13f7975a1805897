"""Labels over ng-routes against a plain enumeration of them, and the ascent that uses them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flockopt.batches.deadline import Deadline
from flockopt.bundles import Bound
from flockopt.bundles.bounds import pricing
from flockopt.bundles.bounds.ng_route import count_pairs, neighbourhood
from flockopt.bundles.bounds.pricing import ascend, ascend_prices, evaluate, evaluate_any_end, group_drones, grow, route_loads
from flockopt.certificate.proof import recompute_bound
from flockopt.travel import Travel
from tests.instances import random_instance, random_scene


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


def test_any_end_has_its_slope_and_is_below_routes_with_their_own():
    rng = np.random.default_rng(3)
    scene, travel = random_instance(rng, drones=3, tasks=8, capacity=3, ends=True)
    without = replace(travel, task_end=np.zeros_like(travel.task_end), start_end=np.full(3, np.inf))
    groups, prices = group_drones(scene, without), np.concatenate([rng.uniform(1, 6, 8), rng.normal(0, 2, 8)])
    value, slope = evaluate_any_end(groups, travel.task_end, travel.start_end, prices)
    assert value == pytest.approx(recompute_bound(scene, travel, Bound("ng-route-any-end", 0.0, prices)))
    assert value <= evaluate(group_drones(scene, travel), prices[:8])[0] + 1e-9
    for other in np.concatenate([rng.uniform(0, 9, (20, 8)), rng.normal(0, 3, (20, 8))], axis=1):
        bound = evaluate_any_end(groups, travel.task_end, travel.start_end, other)[0]
        assert bound <= value + slope @ (other - prices) + 1e-9


def test_the_ascent_never_ends_below_its_start():
    rng = np.random.default_rng(5)
    scene, travel = random_instance(rng, drones=3, tasks=9, capacity=4)
    groups, prices = group_drones(scene, travel), rng.uniform(0, 5, 9)
    value, better = ascend_prices(groups, prices, rounds=30, upper=math.inf)
    assert (better >= 0).all()
    assert evaluate(groups, better)[0] == value > evaluate(groups, prices)[0]


def test_what_a_first_step_reaches_for_can_be_less():
    scene, travel = random_instance(np.random.default_rng(5), drones=3, tasks=9, capacity=4)
    groups, prices, met = group_drones(scene, travel), np.ones(9), []

    def slope(point):
        met.append(point)
        value, visits = evaluate(groups, point)
        return value, 1.0 - visits

    for reach in (0.04, 0.01):
        ascend(slope, prices, np.zeros(9), rounds=2, upper=math.inf, reach=reach)
    assert met[1] - prices == pytest.approx(4.0 * (met[3] - prices))
    assert (met[1] != prices).any()


def test_the_ascent_ends_where_its_time_does():
    scene, travel = random_instance(np.random.default_rng(5), drones=3, tasks=9, capacity=4)
    value, prices = ascend_prices(group_drones(scene, travel), np.ones(9), rounds=30, upper=math.inf, deadline=Deadline(0.0))
    assert value == -math.inf
    assert (prices == 1.0).all()


def test_the_ascent_ends_where_the_bound_is_good_enough(monkeypatch):
    scene, travel = random_instance(np.random.default_rng(5), drones=3, tasks=9, capacity=4)
    groups, evaluated = group_drones(scene, travel), []
    monkeypatch.setattr(pricing, "evaluate", lambda *given: evaluated.append(given) or evaluate(*given))
    best, _ = ascend_prices(groups, np.ones(9), rounds=60, upper=math.inf)
    rounds = len(evaluated)
    value, _ = ascend_prices(groups, np.ones(9), rounds=60, upper=best * 1.04, good=0.05)
    assert best * 1.04 <= value * 1.05
    assert 1 < len(evaluated) - rounds < rounds


def test_labels_are_the_same_in_one_go_and_load_by_load(monkeypatch):
    rng = np.random.default_rng(7)
    scene, travel = random_instance(rng, drones=2, tasks=9, capacity=7, demands=True)
    group, prices = group_drones(scene, travel)[0], rng.uniform(0, 9, 9)
    whole = grow(group, prices)
    monkeypatch.setattr(pricing, "SLICE_PAIRS", 0)
    for one, other in zip(whole, grow(group, prices), strict=True):
        assert (one == other).all()


def test_demands_count_in_their_largest_unit():
    scene = random_scene(np.random.default_rng(2), drones=2, tasks=5, capacity=4, demands=True)
    grams = scene.replace(
        drones=tuple(replace(drone, capacity=1000 * drone.capacity + 7) for drone in scene.drones),
        tasks=tuple(replace(task, demand=1000 * task.demand) for task in scene.tasks),
    )
    assert [load.tolist() for load in route_loads(grams)] == [load.tolist() for load in route_loads(scene)]


@pytest.mark.parametrize("seed", range(4))
def test_count_pairs_counts_the_legs_between_tasks_with_labels(seed):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=1, tasks=6, capacity=9, demands=True)
    demands, capacities = route_loads(scene)
    labels = grow(group_drones(scene, travel)[0], rng.uniform(0, 9, 6))
    filled = (labels.first[1:] > labels.first[:-1]).reshape(-1, 6)  # by load and task
    pairs = sum(filled[load - demand].sum() for load in range(len(filled)) for demand in demands if demand < load)
    assert 0 < pairs <= count_pairs(demands, int(capacities[0]))


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
