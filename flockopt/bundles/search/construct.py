"""Setting a search up: the problem's arrays from a scene and its travel, and a first solution by regret insertion."""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, FLOATS_3, INTEGERS_1, compiled_for, writable
from flockopt.bundles.explain import LENGTH_TOLERANCE_M
from flockopt.bundles.request import RouteTuple
from flockopt.bundles.search.moves import fits_length
from flockopt.bundles.search.state import (
    INDICES_2,
    NUM_WAITING,
    OPTIONS,
    PROBLEM,
    ROUTES,
    UNSERVED,
    IntArray,
    Problem,
    Routes,
    collect_waiting,
    commit,
    empty_routes,
    inner,
    insertion_cost,
    link,
    total_cost,
)
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["NUM_NEAR", "build_problem", "build_routes"]

#: How many of its nearest tasks, and of the nearest kinds of drones, a task is tried beside.
NUM_NEAR, NUM_NEAR_GROUPS = 20, 10


def build_problem(scene: Scene, travel: Travel) -> Problem:
    """The arrays that the search works on."""
    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    limits = [np.inf if drone.max_distance is None else drone.max_distance for drone in scene.drones]
    group, firsts = _groups(scene, travel, limits)
    counts = np.bincount(group)
    distance = np.empty((len(travel.task_task), num_tasks + num_drones, num_tasks + num_drones))
    near = np.empty((num_tasks, min(NUM_NEAR, max(num_tasks - 1, 0))), dtype=np.uint32)
    near_groups = np.empty((num_tasks, min(NUM_NEAR_GROUPS, len(firsts))), dtype=np.uint32)
    remoteness = np.empty(num_tasks)
    no_way, penalty = _measure(
        travel.start_task, travel.task_task, travel.task_end, travel.start_end, np.array(firsts), distance, near, near_groups,
        remoteness, np.empty((num_tasks, num_tasks)), np.empty((num_tasks, len(firsts))),
    )  # fmt: skip
    return Problem(
        distance=distance,
        drone_class=travel.drone_class.astype(np.uint32),
        group=group,
        members=np.argsort(group, kind="stable").astype(np.uint32),
        first_member=(np.cumsum(counts) - counts).astype(np.uint32),
        num_members=counts.astype(np.uint32),
        near=near,
        near_groups=near_groups,
        remoteness=remoteness,
        demand=scene.demands.astype(np.int64),
        capacity=scene.capacities.astype(np.int64),
        longest=np.array(limits) + LENGTH_TOLERANCE_M,
        no_way=no_way,
        penalty=penalty,
    )


@compiled_for(
    FLOATS_2, FLOATS_3, FLOATS_2, FLOATS_1, INTEGERS_1, writable(FLOATS_3), INDICES_2, INDICES_2, writable(FLOATS_1),
    writable(FLOATS_2), writable(FLOATS_2), **OPTIONS,
)  # fmt: skip
def _measure(
    start_task: FloatArray, task_task: FloatArray, task_end: FloatArray, start_end: FloatArray, firsts: NDArray[np.int64],
    distance: FloatArray, near: IntArray, near_groups: IntArray, remoteness: FloatArray, closest: FloatArray, alone: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Fill a problem's lengths and neighbours from those of a travel; returns ``no_way`` and ``penalty``.

    Args:
        start_task: (N, M),
        task_task: (C, M, M),
        task_end: (N, M) and
        start_end: (N,) m, see `flockopt.travel.Travel`.
        firsts: (groups,) the first drone of each group.
        distance: Filled, as are
        near: which, like
        near_groups: and
        remoteness: is described at `Problem`.
        closest: (M, M) m, scratch.
        alone: (M, groups) m, scratch.
    """
    num_drones, num_tasks = start_task.shape
    longest_leg = max(1e-9, _longest(start_task), _longest(task_end), _longest(start_end))
    for kind in range(len(task_task)):
        longest_leg = max(longest_leg, _longest(task_task[kind]))
    penalty = 2.0 * longest_leg * (num_drones + num_tasks)
    no_way = 100.0 * penalty
    distance[:] = no_way
    closest[:] = no_way
    remoteness[:] = no_way
    for kind in range(len(task_task)):
        for task in range(num_tasks):
            for other in range(num_tasks):
                distance[kind, task, other] = min(task_task[kind, task, other], no_way)
                closest[task, other] = min(closest[task, other], task_task[kind, task, other])
            for drone in range(num_drones):
                distance[kind, num_tasks + drone, task] = min(start_task[drone, task], no_way)
                distance[kind, task, num_tasks + drone] = min(task_end[drone, task], no_way)
        for drone in range(num_drones):
            distance[kind, num_tasks + drone, num_tasks + drone] = min(start_end[drone], no_way)
    for task in range(num_tasks):
        for drone in range(num_drones):
            remoteness[task] = min(remoteness[task], start_task[drone, task])
        for group in range(len(firsts)):
            detour = start_task[firsts[group], task] + task_end[firsts[group], task] - start_end[firsts[group]]
            alone[task, group] = detour if detour < np.inf else no_way
    _nearest(closest, near, True)
    _nearest(alone, near_groups, False)
    return no_way, penalty


@inner
def _longest(legs: FloatArray) -> float:
    """The longest leg that can be flown, 0 without any, metres."""
    longest_m = 0.0
    for leg in legs.flat:
        if longest_m < leg < np.inf:
            longest_m = leg
    return longest_m


def _groups(scene: Scene, travel: Travel, limits: list[float]) -> tuple[IntArray, list[int]]:
    """(N,) the group of each drone, and the first drone of each group; drones of a group are interchangeable."""
    numbers: dict[tuple[object, ...], int] = {}
    firsts: list[int] = []
    group = np.empty(scene.num_drones, dtype=np.uint32)
    for i, drone in enumerate(scene.drones):
        legs = travel.start_task[i].tobytes(), travel.task_end[i].tobytes(), float(travel.start_end[i])
        kind = (drone.capacity, limits[i], int(travel.drone_class[i]), *legs)
        if kind not in numbers:
            numbers[kind] = len(firsts)
            firsts.append(i)
        group[i] = numbers[kind]
    return group, firsts


@compiled_for(FLOATS_2, INDICES_2, types.boolean, **OPTIONS)
def _nearest(matrix: FloatArray, nearest: IntArray, skip_self: bool) -> None:
    """Fill row r of ``nearest`` with the columns of the least entries of row r, least first."""
    kept = nearest.shape[1]
    for row in range(len(nearest) if kept else 0):
        count = 0
        for column in range(matrix.shape[1]):
            if skip_self and column == row:
                continue
            if count == kept and matrix[row, column] >= matrix[row, nearest[row, kept - 1]]:
                continue
            place = min(count, kept - 1)
            count = place + 1
            while place > 0 and matrix[row, nearest[row, place - 1]] > matrix[row, column]:
                nearest[row, place] = nearest[row, place - 1]
                place -= 1
            nearest[row, place] = column


def build_routes(problem: Problem, given: RouteTuple, preference: FloatArray, seed: int) -> tuple[Routes, float]:
    """A first solution, and what it costs, metres.

    Tasks of the given routes are served in their order as far as capacities and reach allow; then the waiting ones, first
    those that lose most if their best drone is gone (regret insertion).

    Args:
        problem: The problem.
        given: Routes to begin with, or none.
        preference: (M, N) m, what is added to the travel of serving task j by drone i, or (0, 0) for nothing.
        seed: Of the search to come.
    """
    num_tasks, num_drones = len(problem.demand), len(problem.capacity)
    tasks = np.array([task for route in given for task in route], dtype=np.int64)
    drones = np.repeat(np.arange(len(given)), [len(route) for route in given])
    price, place = np.empty((num_tasks, num_drones)), np.empty((num_tasks, num_drones), dtype=np.uint32)
    ranks = np.empty((2, num_tasks), dtype=np.uint32)
    routes = empty_routes(problem, seed)
    return routes, _build(problem, routes, tasks, drones, preference, price, place, ranks)


@compiled_for(
    PROBLEM, ROUTES, INTEGERS_1, INTEGERS_1, FLOATS_2, writable(FLOATS_2), INDICES_2, INDICES_2, **OPTIONS,
)  # fmt: skip
def _build(
    problem: Problem, routes: Routes, tasks: NDArray[np.int64], drones: NDArray[np.int64], preference: FloatArray,
    price: FloatArray, place: IntArray, ranks: IntArray,
) -> float:  # fmt: skip
    """One call for all of it: to hand a problem and routes over to compiled code takes longer than what it does there."""
    _insert_in_order(problem, routes, tasks, drones)
    _insert_by_regret(problem, routes, preference, price, place, ranks[0], ranks[1])
    commit(routes)
    return total_cost(problem, routes)


@inner
def _insert_in_order(problem: Problem, routes: Routes, tasks: NDArray[np.int64], drones: NDArray[np.int64]) -> None:
    num_tasks = len(problem.demand)
    for place in range(len(tasks)):
        task, drone = tasks[place], drones[place]
        last = np.int64(routes.before[num_tasks + drone])
        cost = insertion_cost(problem, routes, task, last)
        if problem.demand[task] <= routes.room[drone] and fits_length(problem, routes, drone, cost):
            link(problem, routes, task, last)
    collect_waiting(problem, routes)


@inner
def _insert_by_regret(
    problem: Problem, routes: Routes, preference: FloatArray,
    price: FloatArray, place: IntArray, best: IntArray, second: IntArray,
) -> None:  # fmt: skip
    count = routes.counters[NUM_WAITING]
    for entry in range(count):
        task = np.int64(routes.waiting[entry])
        for drone in range(len(problem.capacity)):
            _price(problem, routes, preference, price, place, task, drone)
        _rank(price, best, second, task)
    left = count
    while True:
        chosen, most_regret, least_price = -1, -1.0, np.inf
        for entry in range(left):
            task = routes.waiting[entry]
            cheapest = price[task, best[task]]
            regret = price[task, second[task]] - cheapest if second[task] != UNSERVED else np.inf
            if cheapest < np.inf and (regret > most_regret or (regret == most_regret and cheapest < least_price)):
                chosen, most_regret, least_price = entry, regret, cheapest
        if chosen < 0:
            break
        task = np.int64(routes.waiting[chosen])
        taker = np.int64(best[task])
        link(problem, routes, task, np.int64(place[task, taker]))
        left -= 1
        routes.waiting[chosen] = routes.waiting[left]
        for entry in range(left):
            other = np.int64(routes.waiting[entry])
            _price(problem, routes, preference, price, place, other, taker)
            changed = best[other] == taker or second[other] == taker
            if changed or second[other] == UNSERVED or price[other, taker] < price[other, second[other]]:
                _rank(price, best, second, other)
    routes.counters[NUM_WAITING] = left


@inner
def _rank(price: FloatArray, best: IntArray, second: IntArray, task: int) -> None:
    """Note the cheapest drone for the task and the second cheapest (UNSERVED: there is none)."""
    best[task], second[task] = 0, UNSERVED
    for drone in range(1, price.shape[1]):
        if price[task, drone] < price[task, best[task]]:
            best[task], second[task] = drone, best[task]
        elif second[task] == UNSERVED or price[task, drone] < price[task, second[task]]:
            second[task] = drone


@inner
def _price(
    problem: Problem, routes: Routes, preference: FloatArray, price: FloatArray, place: IntArray, task: int, drone: int
) -> None:
    """Price the task on the drone at its best place, infinite where it does not fit."""
    price[task, drone] = np.inf
    if problem.demand[task] > routes.room[drone]:
        return
    num_tasks, extra = len(problem.demand), 0.0
    if preference.size > 0:
        extra = preference[task, drone]
    node = num_tasks + drone
    while True:
        cost = insertion_cost(problem, routes, task, node)
        if cost + extra < price[task, drone] and fits_length(problem, routes, drone, cost):
            price[task, drone], place[task, drone] = cost + extra, node
        node = routes.after[node]
        if node >= num_tasks:
            break
