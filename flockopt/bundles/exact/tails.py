"""Compiled growth of elementary route tails, and their match with drones; see `flockopt.bundles.exact.enumeration`.

Of all routes only those matter whose slack, their priced cost above the least, is within the gap between the bounds
(Baldacci, Christofides and Mingozzi 2008): an optimal choice holds no other. Tails grow task by task towards the front of a
route; one is dropped as soon as the cheapest way to complete it, an ng-route's, passes the gap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, INTEGERS_2, compiled_for, compiled_lazily
from flockopt.records.arrays import FloatArray

__all__ = ["Tails", "grow_tails", "match_starts", "trace_tails"]

#: Bits of a set that one word holds.
WORD_BITS = 63

#: Odd constant of multiplicative hashing (Knuth), as a signed word.
HASH_FACTOR = -7046029254386353131


class Tails(NamedTuple):
    """Ends of routes, the shortest of each first task and set of tasks."""

    fronts: NDArray[np.int64]  # (T,) the first task
    costs: FloatArray  # (T,) m less prices
    loads: NDArray[np.int64]  # (T,)
    lengths: FloatArray  # (T,) m
    sets: NDArray[np.int64]  # (T, W) bits of the tasks served
    parents: NDArray[np.int64]  # (T,) the tail without its front, or -1


@compiled_lazily()
def _slot(
    table: NDArray[np.int64], fronts: NDArray[np.int64], sets: NDArray[np.int64], front: int, words: NDArray[np.int64]
) -> int:
    """Where the open-addressing table holds, or would hold, the tail of this front and set."""
    key = np.int64(front + 1) * HASH_FACTOR
    for word in range(words.shape[0]):
        key = (key ^ words[word]) * HASH_FACTOR
        key ^= key >> 29
    slot = key & (table.shape[0] - 1)  # the size is a power of two
    while table[slot] >= 0:
        tail = table[slot]
        if fronts[tail] == front:
            same = True
            for word in range(words.shape[0]):
                same &= sets[tail, word] == words[word]
            if same:
                break
        slot = (slot + 1) & (table.shape[0] - 1)
    return slot


@compiled_for(INTEGERS_1, INTEGERS_1, INTEGERS_2, types.int64)
def _rehashed(table: NDArray[np.int64], fronts: NDArray[np.int64], sets: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    bigger = np.full(4 * table.shape[0], -1)
    for tail in range(count):
        bigger[_slot(bigger, fronts, sets, fronts[tail], sets[tail])] = tail
    return bigger


@compiled_for(FLOATS_2, FLOATS_2, FLOATS_1, INTEGERS_1, FLOATS_2, types.float64, types.int64, nogil=True)
def grow_tails(
    between: FloatArray,
    initial: FloatArray,
    prices: FloatArray,
    demands: NDArray[np.int64],
    completions: FloatArray,
    gap: float,
    limit: int,
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.int64], FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """All tails that may be completed within the gap, as the fields of `Tails`; more than ``limit`` of them where it stops.

    Args:
        between: (M, M) m between tasks.
        initial: (Q + 1, M) m of a tail of one task, by its load; infinite where there is none.
        prices: (M,) m, what serving a task earns.
        demands: (M,) load of each task.
        completions: (Q + 1, M) m, least slack that completing adds, by load and front task.
        gap: Most slack, metres.
        limit: Tails at most.
    """
    # Over 60 lines: a tail is looked up, made and bettered in one place, and the table grows between tails; cut apart,
    # each part would take all of the dozen arrays.
    most, num = initial.shape[0] - 1, initial.shape[1]
    room = limit + num + 1
    fronts, costs, loads = np.empty(room, np.int64), np.empty(room), np.empty(room, np.int64)
    lengths, sets = np.empty(room), np.empty((room, (num + WORD_BITS - 1) // WORD_BITS), np.int64)
    parents, later = np.empty(room, np.int64), np.empty(room, np.int64)
    table, words = np.full(4096, -1), np.zeros(sets.shape[1], np.int64)
    of_load = np.full(most + 1, -1)  # head of the list of tails of a load, threaded by `later`
    count = 0
    for load in range(most + 1):
        for front in range(num):
            if initial[load, front] - prices[front] + completions[load, front] <= gap:
                fronts[count], loads[count], parents[count], later[count] = front, load, -1, of_load[load]
                lengths[count], costs[count] = initial[load, front], initial[load, front] - prices[front]
                sets[count] = 0
                sets[count, front // WORD_BITS] = 1 << (front % WORD_BITS)
                of_load[load] = count
                table[_slot(table, fronts, sets, front, sets[count])] = count
                count += 1
        # Demands are positive, so a tail's children are heavier: when its load's turn comes a tail is as short as it gets.
        tail = of_load[load]
        while tail >= 0 and count <= limit:
            # At most half full, also after this tail's children: probes stay short, and end.
            if 2 * (count + num) > table.shape[0]:
                table = _rehashed(table, fronts, sets, count)
            for front in range(num):
                heavier = load + demands[front]
                if heavier > most or sets[tail, front // WORD_BITS] >> (front % WORD_BITS) & 1:
                    continue
                # A tail of the same front and tasks is kept once, by its least cost: any start completes both alike.
                leg = between[front, fronts[tail]]
                cost = costs[tail] + leg - prices[front]
                if not cost + completions[heavier, front] <= gap:
                    continue
                words[:] = sets[tail]
                words[front // WORD_BITS] |= 1 << (front % WORD_BITS)
                slot = _slot(table, fronts, sets, front, words)
                found = table[slot]
                if found < 0:
                    found = count
                    table[slot] = found
                    fronts[found], loads[found], sets[found] = front, heavier, words
                    later[found], of_load[heavier] = of_load[heavier], found
                    costs[found] = np.inf
                    count += 1
                if cost < costs[found]:
                    costs[found], lengths[found], parents[found] = cost, lengths[tail] + leg, tail
            tail = later[tail]
    return fronts[:count], costs[:count], loads[:count], lengths[:count], sets[:count], parents[:count]


@compiled_for(
    INTEGERS_1, FLOATS_1, INTEGERS_1, FLOATS_1, FLOATS_2, FLOATS_1, INTEGERS_1, FLOATS_1, types.float64, types.int64,
    nogil=True,
)  # fmt: skip
def match_starts(
    fronts: NDArray[np.int64],
    costs: FloatArray,
    loads: NDArray[np.int64],
    lengths: FloatArray,
    starts: FloatArray,
    earned: FloatArray,
    capacities: NDArray[np.int64],
    longest: FloatArray,
    gap: float,
    limit: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Drone (R,) and tail (R,) of every route within the gap; more than ``limit`` of them where it stops.

    Args:
        fronts: As in `Tails`.
        costs: As in `Tails`.
        loads: As in `Tails`.
        lengths: As in `Tails`.
        starts: (n, M) m from each start to each task.
        earned: (n,) m, the least that each drone can have.
        capacities: (n,).
        longest: (n,) m that each drone may fly.
        gap: Most slack, metres.
        limit: Routes at most.
    """
    room = limit + starts.shape[0]
    rows, ends = np.empty(room, np.int64), np.empty(room, np.int64)
    count = 0
    for tail in range(fronts.shape[0]):
        for row in range(starts.shape[0]):
            leg = starts[row, fronts[tail]]
            fits = loads[tail] <= capacities[row] and leg + lengths[tail] <= longest[row]
            if fits and leg + costs[tail] - earned[row] <= gap:
                rows[count], ends[count] = row, tail
                count += 1
        if count > limit:
            break
    return rows[:count], ends[:count]


@compiled_for(INTEGERS_1, INTEGERS_1, INTEGERS_1)
def trace_tails(ends: NDArray[np.int64], fronts: NDArray[np.int64], parents: NDArray[np.int64]) -> NDArray[np.int64]:
    """(R, K) tasks of these tails in visiting order, -1 after the last."""
    most = 0
    for end in ends:
        tail, count = end, 0
        while tail >= 0:
            tail, count = parents[tail], count + 1
        most = max(most, count)
    tasks = np.full((ends.shape[0], most), -1)
    for route in range(ends.shape[0]):
        tail, count = ends[route], 0
        while tail >= 0:
            tasks[route, count] = fronts[tail]
            tail, count = parents[tail], count + 1
    return tasks
