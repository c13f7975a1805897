"""Several routes changed at once, optimally: each is cut, and tails are matched anew to heads.

This is an assignment problem, so that the best of all ways to permute the tails costs no more than a ruin; such cyclic
exchanges, whole routes among them, are what ruin and recreate misses where capacities are tight (after Thompson and
Psaraftis, "Cyclic transfer algorithms for multivehicle routing and scheduling problems", Operations Research 41, 1993).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, record_of
from flockopt.bundles.search.state import (
    INDICES_1,
    RUIN,
    UNSERVED,
    IntArray,
    Problem,
    Routes,
    compiled,
    inner,
    random_index,
    random_unit,
    resize,
)
from flockopt.records.arrays import FloatArray

__all__ = ["MATCHING", "Matching", "match_tails", "matching_scratch"]

#: How many routes are changed at once, and how many of them may be resting drones.
MOST_ROUTES, MOST_RESTING = 6, 2

#: How often the routes are cut at their starts.
WHOLE_SHARE = 0.2

#: A permutation is worth making if it saves this many metres.
SAVING_M = 1e-9


class Matching(NamedTuple):
    """Scratch memory. Rows are routes, columns are tails in the order of the routes they are cut from."""

    cost: FloatArray  # (R, R) m
    row_price: FloatArray  # (R + 1,) m, duals of the assignment problem
    column_price: FloatArray  # (R + 1,) m
    slack: FloatArray  # (R + 1,) m
    row_of: IntArray  # (R + 1,) the row matched to each column, both from 1 on; 0 for none
    came_from: IntArray  # (R + 1,)
    is_settled: IntArray  # (R + 1,)
    drone: IntArray  # (R,)
    head: IntArray  # (R,) last node that stays with the drone
    first: IntArray  # (R,) first task of the tail, where there is one
    last: IntArray  # (R,) its last task
    size: NDArray[np.int64]  # (R,) its number of tasks
    load: NDArray[np.int64]  # (R,) its demand
    inner: FloatArray  # (R,) m within it


#: The same as compiled code knows it.
MATCHING = record_of(Matching, FLOATS_2, *[FLOATS_1] * 3, *[INDICES_1] * 7, INTEGERS_1, INTEGERS_1, FLOATS_1)


def matching_scratch() -> Matching:
    """Memory for matchings of any problem."""
    count, indices = MOST_ROUTES, np.uint32
    return Matching(
        cost=np.zeros((count, count)),
        row_price=np.zeros(count + 1),
        column_price=np.zeros(count + 1),
        slack=np.zeros(count + 1),
        row_of=np.zeros(count + 1, dtype=indices),
        came_from=np.zeros(count + 1, dtype=indices),
        is_settled=np.zeros(count + 1, dtype=indices),
        drone=np.zeros(count, dtype=indices),
        head=np.zeros(count, dtype=indices),
        first=np.zeros(count, dtype=indices),
        last=np.zeros(count, dtype=indices),
        size=np.zeros(count, dtype=np.int64),
        load=np.zeros(count, dtype=np.int64),
        inner=np.zeros(count),
    )


@inner
def _gather(problem: Problem, routes: Routes, matching: Matching) -> int:
    """Choose routes around a random task, resting drones among them; returns how many."""
    num_tasks, count = len(problem.demand), 0
    seed = random_index(routes.random, num_tasks)
    routes.counters[RUIN] += 1
    for rank in range(min(MOST_RESTING, problem.near_groups.shape[1])):
        group = problem.near_groups[seed, rank]
        if routes.num_resting[group] > 0:
            matching.drone[count] = routes.resting[problem.first_member[group]]
            matching.head[count] = num_tasks + matching.drone[count]
            count += 1
    for rank in range(-1, problem.near.shape[1]):
        if count == MOST_ROUTES:
            break
        task = seed if rank < 0 else problem.near[seed, rank]
        drone = routes.route[task]
        if drone == UNSERVED or routes.ruined[drone] == routes.counters[RUIN]:
            continue
        if problem.drone_class[drone] == problem.drone_class[matching.drone[0]]:
            routes.ruined[drone] = routes.counters[RUIN]
            matching.drone[count], matching.head[count] = drone, task
            count += 1
    return count


@compiled
def _match(matching: Matching, count: int) -> None:
    """Solve the assignment problem of the first ``count`` rows and columns (shortest augmenting paths)."""
    cost, slack, came_from, row_of = matching.cost, matching.slack, matching.came_from, matching.row_of
    row_price, column_price, is_settled = matching.row_price, matching.column_price, matching.is_settled
    for column in range(count + 1):
        row_of[column], row_price[column], column_price[column] = 0, 0.0, 0.0
    for row in range(1, count + 1):
        row_of[0], column = row, 0
        for other in range(count + 1):
            slack[other], is_settled[other] = np.inf, 0
        while row_of[column] != 0:
            is_settled[column] = 1
            current, step, following = row_of[column], np.inf, 0
            for other in range(1, count + 1):
                if is_settled[other] == 0:
                    reduced = cost[current - 1, other - 1] - row_price[current] - column_price[other]
                    if reduced < slack[other]:
                        slack[other], came_from[other] = reduced, column
                    if slack[other] < step:
                        step, following = slack[other], other
            for other in range(count + 1):
                if is_settled[other] == 1:
                    row_price[row_of[other]] += step
                    column_price[other] -= step
                else:
                    slack[other] -= step
            column = following
        while column != 0:
            previous = came_from[column]
            row_of[column] = row_of[previous]
            column = previous


@compiled
def match_tails(problem: Problem, routes: Routes, matching: Matching) -> float:
    """Cut some routes and give the tails to the heads they fit best; returns the travel it adds, metres.

    Routes are cut where they come near the same task, or sometimes all at their starts.
    """
    count, num_tasks = _gather(problem, routes, matching), len(problem.demand)
    if count < 2:
        return 0.0
    is_whole = random_unit(routes.random) < WHOLE_SHARE
    for part in range(count):
        _cut(problem, routes, matching, part, is_whole)
    before = 0.0
    for row in range(count):
        before += _legs(problem, matching, row, row)
        for column in range(count):
            _price_tail(problem, routes, matching, row, column)
    _match(matching, count)
    after = 0.0
    for column in range(count):
        after += matching.cost[matching.row_of[column + 1] - 1, column]
    if after > before - SAVING_M:
        return 0.0
    for column in range(count):
        _attach(problem, routes, matching, matching.row_of[column + 1] - 1, column)
    for row in range(count):
        node = matching.head[row]
        while True:
            routes.before[routes.after[node]] = node
            node = routes.after[node]
            if node >= num_tasks:
                break
    return after - before


@inner
def _cut(problem: Problem, routes: Routes, matching: Matching, part: int, is_whole: bool) -> None:
    """Note the tail of a gathered route: all of it, or what follows its gathered task or the one before that."""
    num_tasks, drone, head = len(problem.demand), matching.drone[part], matching.head[part]
    if is_whole:
        head = num_tasks + drone
    elif head < num_tasks and random_index(routes.random, np.int64(2)) == 0:
        head = routes.before[head]
    matching.head[part], matching.first[part], matching.last[part] = head, routes.after[head], routes.before[num_tasks + drone]
    kind, node = problem.drone_class[drone], routes.after[head]
    size, load, inner = 0, 0, 0.0
    while node < num_tasks:
        size += 1
        load += problem.demand[node]
        following = routes.after[node]
        if following < num_tasks:
            inner += problem.distance[kind, node, following]
        node = following
    matching.size[part], matching.load[part], matching.inner[part] = size, load, inner


@inner
def _legs(problem: Problem, matching: Matching, row: int, column: int) -> float:
    """Metres of the legs that join the tail of ``column``, as it is, to the head and the end of ``row``."""
    kind, head, end = problem.drone_class[matching.drone[row]], matching.head[row], len(problem.demand) + matching.drone[row]
    if matching.size[column] == 0:
        return problem.distance[kind, head, end]
    return problem.distance[kind, head, matching.first[column]] + problem.distance[kind, matching.last[column], end]


@inner
def _turned_legs(problem: Problem, matching: Matching, row: int, column: int) -> float:
    """The same for the tail turned round."""
    kind, head, end = problem.drone_class[matching.drone[row]], matching.head[row], len(problem.demand) + matching.drone[row]
    if matching.size[column] == 0:
        return problem.distance[kind, head, end]
    return problem.distance[kind, head, matching.last[column]] + problem.distance[kind, matching.first[column], end]


@inner
def _price_tail(problem: Problem, routes: Routes, matching: Matching, row: int, column: int) -> None:
    """Note what it costs to give the tail of ``column`` to the head of ``row``."""
    drone = matching.drone[row]
    legs = min(_legs(problem, matching, row, column), _turned_legs(problem, matching, row, column))
    length = routes.length[drone] - _legs(problem, matching, row, row) - matching.inner[row] + legs + matching.inner[column]
    fits = matching.load[column] <= routes.room[drone] + matching.load[row] and length <= problem.longest[drone]
    matching.cost[row, column] = legs if fits or row == column else problem.no_way


@inner
def _attach(problem: Problem, routes: Routes, matching: Matching, row: int, column: int) -> None:
    """Give the tail of ``column`` to the head of ``row``, turned round if that is shorter; backward links come later."""
    num_tasks, drone, node = len(problem.demand), matching.drone[row], matching.head[row]
    size = matching.size[column]
    turned = _turned_legs(problem, matching, row, column) < _legs(problem, matching, row, column)
    routes.length[drone] += matching.cost[row, column] + matching.inner[column] - matching.inner[row]
    routes.length[drone] -= _legs(problem, matching, row, row)
    routes.room[drone] += matching.load[row] - matching.load[column]
    resize(problem, routes, drone, size - matching.size[row])
    task = matching.last[column] if turned else matching.first[column]
    for _ in range(size):
        following = routes.before[task] if turned else routes.after[task]
        routes.route[task] = drone
        routes.after[node] = task
        node, task = task, following
    routes.after[node] = num_tasks + drone
