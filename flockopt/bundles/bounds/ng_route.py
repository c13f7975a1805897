"""Compiled labels over ng-routes: the cheapest priced routes of every drone from one dynamic program.

An ng-route (Baldacci, Mingozzi and Roberti 2011) may come back to a task only after a task that does not have it
among its nearest ones; it relaxes a route that serves each task once: elementary routes are NP-hard to price, while
ng-routes need one label at most per load, front task and subset of a neighbourhood. Labels grow from the end of a route
towards its first task, so that they know nothing of the drone: drones that share a matrix and an end share all labels, and
a drone's routes are its legs from the start to the labels it can carry.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, compiled_for, compiled_lazily, writable
from flockopt.records.arrays import FloatArray

__all__ = ["Labels", "Neighbourhood", "cheapest_labels", "count_pairs", "count_visits", "grow_labels", "neighbourhood"]

# What the arrays of a `Neighbourhood` are to compiled code.
ORDERS = types.Array(types.int32, 2, "C", readonly=True)
PLACES = tuple(types.Array(types.int8, dimensions, "C", readonly=True) for dimensions in (2, 3))


class Neighbourhood(NamedTuple):
    """Which visited tasks a label remembers: those among the nearest of every task since."""

    order: NDArray[np.int32]  # (M, M - 1) other tasks, nearest first, ties by index
    nearest: NDArray[np.int64]  # (M, G - 1) other tasks, nearest first
    position: NDArray[np.int8]  # (M, M) where task k stands in j's row of `nearest`, or -1
    carried: NDArray[np.int8]  # (M, M, G - 1) position in k's row of the b-th task in j's row, or -1


class Labels(NamedTuple):
    """Partial routes by load and front task; bucket ``load * M + task`` is ``first[bucket]:first[bucket + 1]``."""

    first: NDArray[np.int64]  # ((Q + 1) * M + 1,)
    costs: FloatArray  # (L,) m less prices; ascending within a bucket
    fronts: NDArray[np.int64]  # (L,) the first task
    memories: NDArray[np.int64]  # (L,) bits over the front task's row of `nearest`
    parents: NDArray[np.int64]  # (L,) the label without the front task, -1 for the first one


def neighbourhood(between: FloatArray, size: int) -> Neighbourhood:
    """The ``size`` nearest tasks of each, itself included. ``between`` is (M, M) m."""
    num = len(between)
    ranked = between + np.diag(np.full(num, -np.inf))
    order = np.argsort(ranked, axis=1, kind="stable")[:, 1:].astype(np.int32)
    nearest = order[:, : size - 1].astype(np.int64)
    position = np.full((num, num), -1, dtype=np.int8)
    np.put_along_axis(position, nearest, np.arange(nearest.shape[1], dtype=np.int8)[None], axis=1)
    carried = np.ascontiguousarray(position[:, nearest].transpose(1, 0, 2))
    return Neighbourhood(order, nearest, position, carried)


@compiled_lazily()
def _carry(memory: int, places: NDArray[np.int8]) -> int:
    """The bits of ``memory`` moved to ``places``; those without a place are forgotten."""
    moved, bit = 0, 0
    while memory:
        if memory & 1 and places[bit] >= 0:
            moved |= 1 << places[bit]
        memory >>= 1
        bit += 1
    return moved


@compiled_for(
    FLOATS_2, ORDERS, FLOATS_2, FLOATS_1, INTEGERS_1, *PLACES, types.int64, types.int64, writable(INTEGERS_1),
    *[writable(FLOATS_1)] * 2, *[writable(INTEGERS_1)] * 3,
)  # fmt: skip
def grow_labels(
    between: FloatArray, order: NDArray[np.int32], initial: FloatArray, prices: FloatArray, demands: NDArray[np.int64],
    position: NDArray[np.int8], carried: NDArray[np.int8], begin: int, end: int, first: NDArray[np.int64],
    cheapest: FloatArray, costs: FloatArray, fronts: NDArray[np.int64], memories: NDArray[np.int64],
    parents: NDArray[np.int64],
) -> int:  # fmt: skip
    """Fill in all undominated labels of some loads, by load and then by front task, after those of lighter loads.

    Args:
        between: (M, M) m between tasks.
        order: (M, M - 1) the other tasks by distance.
        initial: (Q + 1, M) m of a route of one task, by load after it; infinite where there is none.
        prices: (M,) m, what serving a task earns.
        demands: (M,) load of each task.
        position: As in `Neighbourhood`.
        carried: As in `Neighbourhood`.
        begin: The first of the loads.
        end: The load after the last one.
        first: As in `Labels`, filled in as far as ``begin``; filled in farther.
        cheapest: (Q + 1,) m of the cheapest label by load; filled in likewise.
        costs: As in `Labels`, with room to spare; filled in, and so are the next ones.
        fronts: See there.
        memories: See there.
        parents: See there.

    Returns:
        The load after the last one filled in: below ``end`` where there is no room for the next one.
    """
    # Over 60 lines: one pass fills a bucket after another, and all that it reads and fills is of this function; the loop
    # over labels, as a function of its own, would take fourteen arrays. It fills in what it is given and returns a number, for
    # numba runs Python to return arrays, and an interrupt that is answered there is a SystemError.
    num = initial.shape[1]
    room, count = costs.shape[0], first[begin * num]
    # The bucket at hand, by memory: what the cheapest label of each memory costs and comes from, and which there are.
    table, origin = np.full(1 << carried.shape[2], np.inf), np.empty(1 << carried.shape[2], np.int64)
    touched = np.empty(1 << carried.shape[2], np.int64)
    for load in range(begin, end):
        cheapest[load] = np.inf
        for front in range(num):
            num_touched = 0
            if initial[load, front] < np.inf:
                table[0], origin[0], touched[0], num_touched = initial[load, front], -1, 0, 1
            before = load - demands[front]
            for rank in range(num - 1 if before > 0 else 0):
                task = order[front, rank]
                leg = between[front, task]
                # A label that remembers nothing dominates all dearer ones, and no later task has a shorter leg.
                if cheapest[before] + leg >= table[0]:
                    break
                # The front may not come again while the label remembers it; it itself is remembered if the new front's
                # neighbourhood has it, and so is what the label remembers of that neighbourhood.
                bit = position[task, front]
                own = 0 if position[front, task] < 0 else 1 << position[front, task]
                for label in range(first[before * num + task], first[before * num + task + 1]):
                    cost = costs[label] + leg
                    # No label through this task remembers less than the task itself.
                    if cost >= table[0] or cost >= table[own]:
                        break
                    if bit >= 0 and (memories[label] >> bit) & 1:
                        continue
                    memory = own | _carry(memories[label], carried[task, front])
                    if cost < table[memory]:
                        if table[memory] == np.inf:
                            touched[num_touched] = memory
                            num_touched += 1
                        table[memory], origin[memory] = cost, label
            if count + num_touched > room:
                return load
            kept = _keep(table, touched[:num_touched], memories[count:], origin, parents[count:], costs[count:])
            for label in range(count, count + kept):
                costs[label] -= prices[front]
                fronts[label] = front
            if kept:
                cheapest[load] = min(cheapest[load], costs[count])
            count += kept
            first[load * num + front + 1] = count
    return end


@compiled_lazily()
def _keep(
    table: FloatArray,
    touched: NDArray[np.int64],
    memories: NDArray[np.int64],
    origin: NDArray[np.int64],
    parents: NDArray[np.int64],
    costs: FloatArray,
) -> int:
    """Write a bucket's undominated labels, cheapest first, empty the table and return their number."""
    # A label dominates a dearer one that remembers all that it does, and more: whatever completes that one completes it.
    kept = 0
    for rank in range(touched.shape[0]):  # in rising order of cost, by selection: buckets are short
        best = rank
        for other in range(rank + 1, touched.shape[0]):
            if table[touched[other]] < table[touched[best]]:
                best = other
        touched[rank], touched[best] = touched[best], touched[rank]
        memory = touched[rank]
        dominated = False
        for other in range(kept):
            if memories[other] & ~memory == 0:
                dominated = True
                break
        if not dominated:
            costs[kept], memories[kept], parents[kept] = table[memory], memory, origin[memory]
            kept += 1
    for rank in range(touched.shape[0]):
        table[touched[rank]] = np.inf
    return kept


@compiled_for(INTEGERS_1, FLOATS_1, FLOATS_2, INTEGERS_1, writable(FLOATS_1), writable(INTEGERS_1))
def cheapest_labels(
    first: NDArray[np.int64], costs: FloatArray, starts: FloatArray, capacities: NDArray[np.int64], values: FloatArray,
    labels: NDArray[np.int64],
) -> None:  # fmt: skip
    """Better what each drone makes of its tasks by its cheapest priced route.

    Args:
        first: As in `Labels`.
        costs: As in `Labels`.
        starts: (N, M) m from each start to each task.
        capacities: (N,) loads that have labels.
        values: (N,) m, what each drone costs by now; bettered.
        labels: (N,) the label that is bettered by.
    """
    num_drones, num = starts.shape
    # Loads rise, so that the cheapest label of all lighter loads is known when a drone's capacity is reached.
    best, cheapest = np.full(num, -1), np.full(num, np.inf)  # by first task, of any load so far
    for load in range((first.shape[0] - 1) // max(num, 1)):
        for task in range(num):
            label = first[load * num + task]
            if label < first[load * num + task + 1] and costs[label] < cheapest[task]:
                best[task], cheapest[task] = label, costs[label]
        for drone in range(num_drones):
            if capacities[drone] == load:
                for task in range(num):
                    if starts[drone, task] + cheapest[task] < values[drone]:
                        values[drone], labels[drone] = starts[drone, task] + cheapest[task], best[task]


@compiled_for(INTEGERS_1, INTEGERS_1, INTEGERS_1, writable(FLOATS_1), writable(FLOATS_1))
def count_visits(
    labels: NDArray[np.int64], fronts: NDArray[np.int64], parents: NDArray[np.int64], visits: FloatArray, lasts: FloatArray
) -> None:
    """Add to ``visits`` (M,) how often the routes of ``labels`` serve each task, to ``lasts`` (M,) how often as their last."""
    for start in labels:
        label = start
        while label >= 0:
            visits[fronts[label]] += 1.0
            if parents[label] < 0:
                lasts[fronts[label]] += 1.0
            label = parents[label]


@compiled_for(INTEGERS_1, types.int64)
def count_pairs(demands: NDArray[np.int64], most: int) -> int:
    """How many steps there are from a task to the one before it, over all loads up to ``most``, where labels can be."""
    labelled, pairs = np.zeros(most + 1, np.int64), 0  # tasks with labels, by load
    for load in range(1, most + 1):
        for task in range(demands.shape[0]):
            before = labelled[load - demands[task]] if demands[task] < load else 0
            pairs += before
            if before or demands[task] == load:
                labelled[load] += 1
    return pairs
