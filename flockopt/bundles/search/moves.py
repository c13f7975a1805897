"""Ruin and recreate: take strings of neighbouring tasks off neighbouring routes, put them back greedily.

After Christiaens and Vanden Berghe, "Slack induction by string removals for vehicle routing problems"
(Transportation Science 54, 2020), for open routes of drones that differ in start, end, capacity and reach.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockopt.bundles.search.state import (
    NUM_RESTING,
    NUM_TORN,
    NUM_WAITING,
    RUIN,
    UNSERVED,
    Problem,
    Routes,
    compiled,
    inner,
    insertion_cost,
    link,
    random_index,
    random_unit,
    unlink,
)

__all__ = ["best_place", "recreate", "ruin"]

#: Longest string taken off one route (from the paper).
LONGEST_STRING = 10

#: How often a string keeps tasks in its middle, and how often one more than so far (from the paper).
SPLIT_SHARE, KEEP_SHARE = 0.5, 0.01

#: How many tasks that waited before a ruin are tried again after it.
NUM_RETRIED = 10


@compiled
def ruin(problem: Problem, routes: Routes, mean_ruined: float) -> float:
    """Take about ``mean_ruined`` tasks off routes near a random task; returns the travel this adds, metres."""
    num_tasks = len(problem.demand)
    busy = len(problem.capacity) - routes.counters[NUM_RESTING]
    if busy == 0:
        return 0.0
    routes.counters[RUIN] += 1
    routes.counters[NUM_TORN] = 0
    longest = min(float(LONGEST_STRING), (num_tasks - routes.counters[NUM_WAITING]) / busy)
    most_strings = max(0.0, 4.0 * mean_ruined / (1.0 + longest) - 1.0)
    strings_left = int(1.0 + most_strings * random_unit(routes.random))
    seed = random_index(routes.random, num_tasks)
    cost = 0.0
    for rank in range(-1, problem.near.shape[1]):
        task = seed if rank < 0 else problem.near[seed, rank]
        drone = routes.route[task]
        if drone == UNSERVED or routes.ruined[drone] == routes.counters[RUIN]:
            continue
        routes.ruined[drone] = routes.counters[RUIN]
        routes.torn[routes.counters[NUM_TORN]] = drone
        routes.counters[NUM_TORN] += 1
        cost += _take_string(problem, routes, task, min(longest, routes.size[drone]))
        strings_left -= 1
        if strings_left == 0:
            break
    return cost


@inner
def _take_string(problem: Problem, routes: Routes, task: int, longest: float) -> float:
    """Take a random string around ``task`` off its route, whole or with a few tasks kept in its middle."""
    drone, num_tasks = routes.route[task], len(problem.demand)
    taken = min(int(1.0 + longest * random_unit(routes.random)), routes.size[drone])
    kept = 0
    if 1 < taken < routes.size[drone] and random_unit(routes.random) < SPLIT_SHARE:
        kept = 1
        while taken + kept < routes.size[drone] and random_unit(routes.random) < KEEP_SHARE:
            kept += 1
    span = taken + kept
    # how far the string may reach back and must reach back, so as to hold `task` and stay on the route
    most_back, node = 0, task
    while most_back < span - 1 and routes.before[node] < num_tasks:
        node, most_back = routes.before[node], most_back + 1
    most_ahead, last = 0, task
    while most_ahead < span - 1 and routes.after[last] < num_tasks:
        last, most_ahead = routes.after[last], most_ahead + 1
    least_back = span - 1 - most_ahead
    for _ in range(random_index(routes.random, most_back - least_back + 1)):
        node = routes.after[node]
    first_kept = 1 + random_index(routes.random, taken - 1) if kept > 0 else span
    cost = 0.0
    for place in range(span):
        following = routes.after[node]
        if place < first_kept or place >= first_kept + kept:
            cost += unlink(problem, routes, np.int64(node))
            routes.waiting[routes.counters[NUM_WAITING]] = node
            routes.counters[NUM_WAITING] += 1
        node = following
    return cost


@compiled
def recreate(problem: Problem, routes: Routes, num_waited: int, blink_share: float) -> float:
    """Put waiting tasks back where it costs least, in a random kind of order; returns the travel this adds, metres.

    Args:
        problem: The problem.
        routes: Changed in place; tasks without a feasible place go on waiting.
        num_waited: How many of the waiting tasks were so before the ruin; a sample of them is tried again.
        blink_share: How often a place is overlooked on purpose.
    """
    retried = min(num_waited, NUM_RETRIED)
    for back in range(retried):
        other, place = random_index(routes.random, num_waited - back), num_waited - 1 - back
        routes.waiting[other], routes.waiting[place] = routes.waiting[place], routes.waiting[other]
    first = num_waited - retried
    tried = routes.waiting[first : routes.counters[NUM_WAITING]]
    _sort_for_recreation(problem, routes, tried)
    cost = 0.0
    routes.counters[NUM_WAITING] = first
    for place in range(len(tried)):
        task = np.int64(tried[place])
        previous, added = best_place(problem, routes, task, blink_share)
        if previous == UNSERVED:
            routes.waiting[routes.counters[NUM_WAITING]] = task
            routes.counters[NUM_WAITING] += 1
        else:
            link(problem, routes, task, previous)
            cost += added
    return cost


@inner
def _sort_for_recreation(problem: Problem, routes: Routes, tasks: NDArray[np.uint32]) -> None:
    """Sort in place: at random, heaviest first, farthest first or nearest first (weights 4, 4, 2, 1 from the paper)."""
    kind = random_index(routes.random, np.int64(11))
    for place in range(len(tasks)):
        task = tasks[place]
        key = random_unit(routes.random)
        if 4 <= kind < 8:
            key -= problem.demand[task]
        elif 8 <= kind < 10:
            key = -problem.remoteness[task]
        elif kind == 10:
            key = problem.remoteness[task]
        low = place
        while low > 0 and routes.sort_key[low - 1] > key:
            tasks[low], routes.sort_key[low] = tasks[low - 1], routes.sort_key[low - 1]
            low -= 1
        tasks[low], routes.sort_key[low] = task, key


@inner
def best_place(problem: Problem, routes: Routes, task: int, blink_share: float) -> tuple[int, float]:
    """The node behind which ``task`` costs least, and what it adds, metres; UNSERVED where nothing is feasible.

    Looked at are the places beside its nearest tasks and in the nearest drones that rest, each overlooked with
    probability ``blink_share``; only where none of them is feasible, all places on the ruined routes, and then all there are.
    """
    distance, drone_class, longest = problem.distance, problem.drone_class, problem.longest
    route, before, after, room, length = routes.route, routes.before, routes.after, routes.room, routes.length
    near, random, demand = problem.near, routes.random, problem.demand[task]
    num_tasks, cutoff = len(problem.demand), 0.5 * problem.no_way
    best, best_cost = UNSERVED, cutoff
    for rank in range(near.shape[1]):
        neighbour = near[task, rank]
        drone = route[neighbour]
        if drone == UNSERVED or demand > room[drone]:
            continue
        kind = drone_class[drone]
        leg = distance[kind, task, neighbour]
        node = after[neighbour]
        cost = leg + distance[kind, task, node] - distance[kind, neighbour, node]
        if cost < best_cost and length[drone] + cost <= longest[drone] and random_unit(random) > blink_share:
            best, best_cost = neighbour, cost
        node = before[neighbour]
        to_task = distance[kind, task, node] if node < num_tasks else distance[kind, node, task]
        cost = to_task + leg - distance[kind, node, neighbour]
        if cost < best_cost and length[drone] + cost <= longest[drone] and random_unit(random) > blink_share:
            best, best_cost = node, cost
    near_groups, num_resting, resting = problem.near_groups, routes.num_resting, routes.resting
    for rank in range(near_groups.shape[1]):
        group = near_groups[task, rank]
        if num_resting[group] == 0:
            continue
        drone = resting[problem.first_member[group]]
        if demand > room[drone]:
            continue
        node, kind = num_tasks + drone, drone_class[drone]
        cost = distance[kind, node, task] + distance[kind, task, node] - distance[kind, node, node]
        if cost < best_cost and length[drone] + cost <= longest[drone] and random_unit(random) > blink_share:
            best, best_cost = node, cost
    if best == UNSERVED:
        return _best_of_torn(problem, routes, task)
    return best, best_cost


@inner
def fits_length(problem: Problem, routes: Routes, drone: int, cost: float) -> bool:
    """Whether the drone may fly ``cost`` metres more than now, and there is a way at all."""
    return routes.length[drone] + cost <= problem.longest[drone] and cost < 0.5 * problem.no_way


@inner
def _best_of_torn(problem: Problem, routes: Routes, task: int) -> tuple[int, float]:
    """The best place on the routes that the ruin took tasks from, for it left room there; failing that, of all places."""
    best, best_cost = UNSERVED, np.inf
    for entry in range(routes.counters[NUM_TORN]):
        best, best_cost = _best_on_route(problem, routes, task, np.int64(routes.torn[entry]), best, best_cost)
    if best != UNSERVED:
        return best, best_cost
    return _best_of_all_places(problem, routes, task)


@inner
def _best_on_route(problem: Problem, routes: Routes, task: int, drone: int, best: int, best_cost: float) -> tuple[int, float]:
    """The best place so far, or a better one on the drone's route."""
    if problem.demand[task] > routes.room[drone]:
        return best, best_cost
    num_tasks = len(problem.demand)
    node = num_tasks + drone
    while True:
        cost = insertion_cost(problem, routes, task, node)
        if cost < best_cost and fits_length(problem, routes, drone, cost):
            best, best_cost = node, cost
        node = routes.after[node]
        if node >= num_tasks:
            break
    return best, best_cost


@inner
def _best_of_all_places(problem: Problem, routes: Routes, task: int) -> tuple[int, float]:
    best, best_cost = UNSERVED, np.inf
    for drone in range(len(problem.capacity)):
        best, best_cost = _best_on_route(problem, routes, task, drone, best, best_cost)
    return best, best_cost
