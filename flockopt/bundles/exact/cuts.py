"""Rules of whole routes that mixtures of routes break: subset-row cuts and capacity cuts.

Half of each of three routes can serve three tasks of which each route serves two; but of any three tasks, at most one
whole route serves two or more (Jepsen, Petersen, Spoorendonk and Pisinger 2008). And tasks that together outweigh two
drones need three routes that serve some of them, not two and a half (Baldacci, Christofides and Mingozzi 2008).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLAGS_2, FLOATS_1, INTEGERS_2, compiled_for
from flockopt.records.arrays import FloatArray

__all__ = ["Cuts", "no_cuts", "violated_cuts"]

#: A cut is broken by at least this much.
LEAST_VIOLATION = 0.02

#: Triples that are looked at in one go, at most.
MOST_TRIPLES = 4096


class Cuts(NamedTuple):
    """Rows ``lower <= members @ shares <= upper`` over the routes of a pool."""

    members: NDArray[np.bool_]  # (T, R)
    lower: FloatArray  # (T,)
    upper: FloatArray  # (T,)

    def joined(self, more: Cuts) -> Cuts:
        """These and more of the same pool."""
        return Cuts(*(np.concatenate(pair) for pair in zip(self, more, strict=True)))


def no_cuts(num_routes: int) -> Cuts:
    """To begin with."""
    return Cuts(np.empty((0, num_routes), dtype=np.bool_), np.empty(0), np.empty(0))


def violated_cuts(
    tasks: NDArray[np.int64],
    used: NDArray[np.int64],
    shares: FloatArray,
    demands: FloatArray,
    capacities: FloatArray,
    most: int,
) -> Cuts:
    """The cuts of either kind that these shares break most, ``most`` at most.

    Args:
        tasks: (R, K) tasks of the pool's routes, -1 after the last.
        used: (U,) routes that are flown in part.
        shares: (U,) how much of each.
        demands: (M,).
        capacities: (N,).
        most: Of each kind.
    """
    serves = np.zeros((len(used), len(demands) + 1), dtype=np.bool_)
    np.put_along_axis(serves, tasks[used], True, axis=1)
    serves = np.ascontiguousarray(serves[:, :-1])  # the last one took the padding
    triples, violations = _broken_triples(serves, shares)
    triples = triples[np.argsort(-violations, kind="stable")[:most]]
    pairs = Cuts(_serve(tasks, _as_sets(triples, len(demands)), 2), np.full(len(triples), -np.inf), np.ones(len(triples)))
    carried = np.cumsum(np.sort(capacities)[::-1])
    sets, needs, gaps = _broken_capacities(serves, shares, demands, carried)
    chosen = np.unique(np.column_stack([-gaps, needs, sets]), axis=0)[:most]  # sorted by gap
    sets, needs = chosen[:, 2:].astype(np.bool_), chosen[:, 1]
    return pairs.joined(Cuts(_serve(tasks, sets, 1), needs, np.full(len(needs), np.inf)))


def _as_sets(members: NDArray[np.int64], num_tasks: int) -> NDArray[np.bool_]:
    sets = np.zeros((len(members), num_tasks), dtype=np.bool_)
    np.put_along_axis(sets, members, True, axis=1)
    return sets


@compiled_for(INTEGERS_2, FLAGS_2, types.int64)
def _serve(tasks: NDArray[np.int64], sets: NDArray[np.bool_], least: int) -> NDArray[np.bool_]:
    """(T, R) whether each route (its row of ``tasks``) serves ``least`` or more tasks of each set (T, M)."""
    result = np.zeros((sets.shape[0], tasks.shape[0]), np.bool_)
    for cut in range(sets.shape[0]):
        for route in range(tasks.shape[0]):
            count = 0
            for task in tasks[route]:
                if task >= 0 and sets[cut, task]:
                    count += 1
            result[cut, route] = count >= least
    return result


@compiled_for(FLAGS_2, FLOATS_1)
def _broken_triples(serves: NDArray[np.bool_], shares: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Triples of tasks (T, 3) that routes with two or more of them serve more than once, and by how much (T,)."""
    num = serves.shape[1]
    pairs = np.zeros((num, num))
    for route in range(serves.shape[0]):
        for a in range(num):
            if serves[route, a]:
                for b in range(num):
                    if serves[route, b]:
                        pairs[a, b] += shares[route]
    triples, violations, count = np.empty((MOST_TRIPLES, 3), np.int64), np.empty(MOST_TRIPLES), 0
    for a in range(num):
        for b in range(a + 1, num):
            for c in range(b + 1, num):
                total = pairs[a, b] + pairs[a, c] + pairs[b, c] - 1.0
                if total < LEAST_VIOLATION:
                    continue
                # A route that serves all three counts once, not for each of the three pairs.
                for route in range(serves.shape[0]):
                    if serves[route, a] and serves[route, b] and serves[route, c]:
                        total -= 2.0 * shares[route]
                if total >= LEAST_VIOLATION and count < MOST_TRIPLES:
                    triples[count] = (a, b, c)
                    violations[count] = total
                    count += 1
    return triples[:count], violations[:count]


@compiled_for(FLAGS_2, FLOATS_1, FLOATS_1, FLOATS_1)
def _broken_capacities(
    serves: NDArray[np.bool_], shares: FloatArray, demands: FloatArray, carried: FloatArray
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
    """Sets of tasks (T, M) served by fewer routes than can carry them, the routes needed (T,) and lacking (T,).

    A set grows from each task by the task that adds least to the routes that serve the set; the worst on the way is kept.

    Args:
        serves: (U, M).
        shares: (U,).
        demands: (M,).
        carried: (N,) what the 1, 2, ... largest drones carry together.
    """
    num_routes, num = serves.shape
    sets, needs, gaps = np.zeros((num, num), np.bool_), np.zeros(num), np.zeros(num)
    inside, covered, added = np.empty(num, np.bool_), np.empty(num_routes, np.bool_), np.empty(num)
    for seed in range(num):
        inside[:], covered[:], added[:] = False, False, 0.0
        for route in range(num_routes):
            for task in range(num):
                if serves[route, task]:
                    added[task] += shares[route]
        load, served, task = 0.0, 0.0, seed
        for _ in range(num):
            inside[task] = True
            load += demands[task]
            for route in range(num_routes):
                if serves[route, task] and not covered[route]:
                    covered[route] = True
                    served += shares[route]
                    for other in range(num):
                        if serves[route, other]:
                            added[other] -= shares[route]
            need = np.searchsorted(carried, load) + 1.0
            if need - served > gaps[seed]:
                sets[seed], needs[seed], gaps[seed] = inside, need, need - served
            task = -1
            for other in range(num):
                if not inside[other] and (task < 0 or added[other] < added[task]):
                    task = other
    broken = gaps >= LEAST_VIOLATION
    return sets[broken], needs[broken], gaps[broken]
