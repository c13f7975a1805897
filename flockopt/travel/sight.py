"""Compiled: which features see each other and which points see them, along lines that a shortest path may take."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_2, INTEGERS_1, compiled_for, compiled_lazily, record_of
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import FEATURES, Features
from flockopt.travel.blocking import blocker

__all__ = ["SIGHT", "Sight", "View", "empty_sight", "look_around", "norm", "sees", "step", "tangent", "wraps"]

Step: TypeAlias = tuple[float, float, float]

UNKNOWN, SEEN, HIDDEN = 0, 1, 2


class View(NamedTuple):
    """Points among features, and what of these they see as far as anyone asked."""

    space: FreeSpace
    features: Features
    points: FloatArray  # (P, 3) m
    seen: NDArray[np.uint8]  # (P, F) UNKNOWN, SEEN or HIDDEN; filled by `sees`


class Sight(NamedTuple):
    """Which features see each other, as far as anyone asked: a pool of sorted lists, one per feature."""

    pool: NDArray[np.int32]  # (room,) feature indices
    begin: NDArray[np.int64]  # (F,) where a feature's list begins in the pool, -1 if nobody asked
    end: NDArray[np.int64]  # (F,)
    used: NDArray[np.int64]  # (1,) filled part of the pool


#: The same as compiled code knows them.
VIEW = types.NamedTuple([FREE_SPACE, FEATURES, FLOATS_2, types.Array(types.uint8, 2, "C")], View)
SIGHT = record_of(Sight, types.Array(types.int32, 1, "C"), *[INTEGERS_1] * 3)


def empty_sight(num_features: int) -> Sight:
    """Nothing known yet."""
    return Sight(
        np.empty(max(16 * num_features, 64), dtype=np.int32),
        np.full(num_features, -1, dtype=np.int64),
        np.zeros(num_features, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
    )


@compiled_for(FLOATS_2, types.int64, FLOATS_2, types.int64, error_model="numpy")
def step(points: FloatArray, i: int, others: FloatArray, j: int) -> Step:
    """From the i-th of some points (P, 3) to the j-th of others (Q, 3), metres."""
    return others[j, 0] - points[i, 0], others[j, 1] - points[i, 1], others[j, 2] - points[i, 2]


@compiled_lazily(error_model="numpy")
def norm(d: Step) -> float:
    """Metres."""
    return math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


@compiled_lazily(error_model="numpy")
def tangent(features: Features, u: int, d: Step) -> bool:
    """Whether a line of direction d through feature u stays out of the prism there."""
    first, second = features.first, features.second
    a = d[0] * first[u, 0] + d[1] * first[u, 1] + d[2] * first[u, 2]
    b = d[0] * second[u, 0] + d[1] * second[u, 1] + d[2] * second[u, 2]
    return a * b <= features.slack[u] * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


@compiled_lazily(error_model="numpy")
def wraps(features: Features, u: int, i: Step, o: Step) -> bool:
    """Whether the bend from direction i into direction o is around the obstacle of feature u, not away from it."""
    first, second = features.first, features.second
    come, go = norm(i), norm(o)
    limit = features.bend * come * go
    # the turn of the unit direction, times both lengths: a taut string turns towards what it is wound around
    t0, t1, t2 = o[0] * come - i[0] * go, o[1] * come - i[1] * go, o[2] * come - i[2] * go
    a = t0 * first[u, 0] + t1 * first[u, 1] + t2 * first[u, 2]
    b = t0 * second[u, 0] + t1 * second[u, 1] + t2 * second[u, 2]
    return a <= limit and b <= limit


@compiled_lazily(error_model="numpy")
def _knows(pool: NDArray[np.int32], begin: int, end: int, u: int) -> bool:
    """Whether u stands in the sorted list that begins and ends there."""
    low, high = begin, end
    while low < high:
        middle = (low + high) // 2
        if pool[middle] < u:
            low = middle + 1
        else:
            high = middle
    return low < end and pool[low] == u


@compiled_lazily(error_model="numpy")
def look_around(view: View, sight: Sight, u: int) -> Sight:
    """Fill the list of feature u: every feature it sees along a line tangent at both."""
    space, features = view.space, view.features
    position, pool, begin, used = features.position, sight.pool, sight.begin, sight.used[0]
    begin[u] = used
    guess = -1
    for v in range(position.shape[0]):
        if v == u:
            continue
        if begin[v] >= 0:
            clear = _knows(pool, begin[v], sight.end[v], u)  # sight is mutual
        else:
            go = step(position, u, position, v)
            if not (tangent(features, u, go) and tangent(features, v, go)):
                continue
            found = blocker(space, position[u], position[v], guess)
            clear = found < 0
            guess = guess if clear else found
        if clear:
            if used == pool.shape[0]:
                wider = np.empty(2 * used, dtype=np.int32)
                for entry in range(used):
                    wider[entry] = pool[entry]
                pool = wider
            pool[used] = v
            used += 1
    sight.end[u] = used
    sight.used[0] = used
    return Sight(pool, begin, sight.end, sight.used)


@compiled_for(VIEW, types.int64, types.int64, types.int64, error_model="numpy")
def sees(view: View, point: int, u: int, guess: int) -> int:
    """-1 if a point sees feature u along a line tangent there; else what blocks it (K if unknown)."""
    seen = view.seen
    if seen[point, u] != UNKNOWN:
        return -1 if seen[point, u] == SEEN else view.space.table.shape[0]
    points, position, found = view.points, view.features.position, view.space.table.shape[0]
    if tangent(view.features, u, step(points, point, position, u)):
        found = blocker(view.space, points[point], position[u], guess)
    seen[point, u] = SEEN if found < 0 else HIDDEN
    return found
