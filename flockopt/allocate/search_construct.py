"""Setting a search up: the problem's arrays from a scene and its travel, and a first solution by regret insertion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockopt.allocate.explain import LENGTH_TOLERANCE_M
from flockopt.allocate.request import RouteTuple
from flockopt.allocate.search_moves import fits_length
from flockopt.allocate.search_state import (
    NUM_WAITING,
    UNSERVED,
    IntArray,
    Problem,
    Routes,
    collect_waiting,
    compiled,
    insertion_cost,
    link,
)
from flockopt.geometry import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["NUM_NEAR", "build_problem", "insert_by_regret", "insert_routes"]

#: How many of its nearest tasks, and of the nearest kinds of drones, a task is tried beside.
NUM_NEAR, NUM_NEAR_GROUPS = 20, 10


def build_problem(scene: Scene, travel: Travel) -> Problem:
    """The arrays that the search works on."""
    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    limits = [np.inf if drone.max_distance is None else drone.max_distance for drone in scene.drones]
    start_task, no_way, penalty = travel.start_task, *_penalties(travel)
    distance = np.full((len(travel.task_task), num_tasks + num_drones, num_tasks + num_drones), no_way)
    distance[:, :num_tasks, :num_tasks] = travel.task_task
    distance[:, num_tasks:, :num_tasks] = start_task
    distance[:, :num_tasks, num_tasks:] = travel.task_end.T
    depots = np.arange(num_tasks, num_tasks + num_drones)
    distance[:, depots, depots] = travel.start_end
    np.minimum(distance, no_way, out=distance)
    group, firsts = _groups(scene, travel, limits)
    counts = np.bincount(group)
    near = np.empty((num_tasks, min(NUM_NEAR, max(num_tasks - 1, 0))), dtype=np.uint32)
    _nearest(distance[:, :num_tasks, :num_tasks].min(axis=0), near, True)
    alone = start_task[firsts] + travel.task_end[firsts] - travel.start_end[firsts, None]  # (groups, M) m
    near_groups = np.empty((num_tasks, min(NUM_NEAR_GROUPS, len(firsts))), dtype=np.uint32)
    _nearest(np.ascontiguousarray(np.nan_to_num(alone, nan=no_way, posinf=no_way).T), near_groups, False)
    return Problem(
        distance=distance,
        drone_class=travel.drone_class.astype(np.uint32),
        group=group,
        members=np.argsort(group, kind="stable").astype(np.uint32),
        first_member=(np.cumsum(counts) - counts).astype(np.uint32),
        num_members=counts.astype(np.uint32),
        near=near,
        near_groups=near_groups,
        remoteness=np.minimum(start_task.min(axis=0), no_way),
        demand=scene.demands.astype(np.int64),
        capacity=scene.capacities.astype(np.int64),
        longest=np.array(limits) + LENGTH_TOLERANCE_M,
        no_way=no_way,
        penalty=penalty,
    )


def _penalties(travel: Travel) -> tuple[float, float]:
    """Finite lengths that outweigh any travel: of a leg without a way, and of a task not served."""
    longest_leg = 1e-9
    for legs in (travel.start_task, travel.task_task, travel.task_end, travel.start_end):
        longest_leg = max(longest_leg, float(np.max(legs, initial=0.0, where=np.isfinite(legs))))
    penalty = 2.0 * longest_leg * sum(travel.start_task.shape)
    return 100.0 * penalty, penalty


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


@compiled
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


def insert_routes(problem: Problem, routes: Routes, given: RouteTuple) -> None:
    """Serve tasks in the given order as far as capacities and reach allow; the others go on waiting."""
    tasks = np.array([task for route in given for task in route], dtype=np.int64)
    drones = np.repeat(np.arange(len(given)), [len(route) for route in given])
    _insert_in_order(problem, routes, tasks, drones)


@compiled
def _insert_in_order(problem: Problem, routes: Routes, tasks: NDArray[np.int64], drones: NDArray[np.int64]) -> None:
    num_tasks = len(problem.demand)
    for place in range(len(tasks)):
        task, drone = tasks[place], drones[place]
        last = np.int64(routes.before[num_tasks + drone])
        cost = insertion_cost(problem, routes, task, last)
        if problem.demand[task] <= routes.room[drone] and fits_length(problem, routes, drone, cost):
            link(problem, routes, task, last)
    collect_waiting(problem, routes)


def insert_by_regret(problem: Problem, routes: Routes, preference: FloatArray) -> None:
    """Serve the waiting tasks, first those that lose most if their best drone is gone (regret insertion).

    Args:
        problem: The problem.
        routes: Changed in place.
        preference: (M, N) m, what is added to the travel of serving task j by drone i, or (0, 0) for nothing.
    """
    num_tasks, num_drones = len(problem.demand), len(problem.capacity)
    price, place = np.empty((num_tasks, num_drones)), np.empty((num_tasks, num_drones), dtype=np.uint32)
    best, second = np.empty(num_tasks, dtype=np.uint32), np.empty(num_tasks, dtype=np.uint32)
    _insert_by_regret(problem, routes, preference, price, place, best, second)


@compiled
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


@compiled
def _rank(price: FloatArray, best: IntArray, second: IntArray, task: int) -> None:
    """Note the cheapest drone for the task and the second cheapest (UNSERVED: there is none)."""
    best[task], second[task] = 0, UNSERVED
    for drone in range(1, price.shape[1]):
        if price[task, drone] < price[task, best[task]]:
            best[task], second[task] = drone, best[task]
        elif second[task] == UNSERVED or price[task, drone] < price[task, second[task]]:
            second[task] = drone


@compiled
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
