"""Compiled: which features see each other and which points see them, along lines that a shortest path may take."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, INTEGERS_1, compiled_for, record_of
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import FEATURES, Features
from flockopt.travel.blocking import blocker

__all__ = ["Sight", "empty_sight", "look_around", "sees", "tangent", "wraps"]

UNKNOWN, SEEN, HIDDEN = 0, 1, 2


class Sight(NamedTuple):
    """Which features see each other, as far as anyone asked: a pool of sorted lists, one per feature."""

    pool: NDArray[np.int32]  # (room,) feature indices
    begin: NDArray[np.int64]  # (F,) where a feature's list begins in the pool, -1 if nobody asked
    end: NDArray[np.int64]  # (F,)
    used: NDArray[np.int64]  # (1,) filled part of the pool


#: The same as compiled code knows it, and what points see.
SIGHT = record_of(Sight, types.Array(types.int32, 1, "C"), *[INTEGERS_1] * 3)
VIEWS = types.Array(types.uint8, 2, "C")


def empty_sight(num_features: int) -> Sight:
    """Nothing known yet."""
    return Sight(
        np.empty(max(16 * num_features, 64), dtype=np.int32),
        np.full(num_features, -1, dtype=np.int64),
        np.zeros(num_features, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
    )


@njit(cache=True, error_model="numpy")
def tangent(first: FloatArray, second: FloatArray, slack: FloatArray, u: int, d0: float, d1: float, d2: float) -> bool:
    """Whether a line of direction d through feature u stays out of the prism there."""
    a = d0 * first[u, 0] + d1 * first[u, 1] + d2 * first[u, 2]
    b = d0 * second[u, 0] + d1 * second[u, 1] + d2 * second[u, 2]
    return a * b <= slack[u] * (d0 * d0 + d1 * d1 + d2 * d2)


@njit(cache=True, error_model="numpy")
def wraps(
    first: FloatArray, second: FloatArray, bend: float, u: int,
    i0: float, i1: float, i2: float, o0: float, o1: float, o2: float,
) -> bool:  # fmt: skip
    """Whether the bend from direction i into direction o is around the obstacle of feature u, not away from it."""
    come, go = math.sqrt(i0 * i0 + i1 * i1 + i2 * i2), math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
    limit = bend * come * go
    t0, t1, t2 = o0 * come - i0 * go, o1 * come - i1 * go, o2 * come - i2 * go
    a = t0 * first[u, 0] + t1 * first[u, 1] + t2 * first[u, 2]
    b = t0 * second[u, 0] + t1 * second[u, 1] + t2 * second[u, 2]
    return a <= limit and b <= limit


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def look_around(space: FreeSpace, features: Features, sight: Sight, u: int) -> Sight:
    """Fill the list of feature u: every feature it sees along a line tangent at both."""
    position, first, second, slack = features.position, features.first, features.second, features.slack
    pool, begin, used = sight.pool, sight.begin, sight.used[0]
    begin[u] = used
    here, there = np.empty(3), np.empty(3)
    here[0], here[1], here[2] = position[u, 0], position[u, 1], position[u, 2]
    guess = -1
    for v in range(position.shape[0]):
        if v == u:
            continue
        if begin[v] >= 0:
            clear = _knows(pool, begin[v], sight.end[v], u)
        else:
            there[0], there[1], there[2] = position[v, 0], position[v, 1], position[v, 2]
            d0, d1, d2 = there[0] - here[0], there[1] - here[1], there[2] - here[2]
            if not (tangent(first, second, slack, u, d0, d1, d2) and tangent(first, second, slack, v, d0, d1, d2)):
                continue
            found = blocker(space, here, there, guess)
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


@compiled_for(FREE_SPACE, FEATURES, VIEWS, types.int64, FLOATS_1, types.int64, FLOATS_1, types.int64, error_model="numpy")
def sees(
    space: FreeSpace,
    features: Features,
    views: NDArray[np.uint8],
    point: int,
    p: FloatArray,
    u: int,
    at: FloatArray,
    guess: int,
) -> int:
    """-1 if the point at p sees feature u, at ``at``, along a line tangent there; else what blocks it (K if unknown)."""
    if views[point, u] != UNKNOWN:
        return -1 if views[point, u] == SEEN else space.table.shape[0]
    found = space.table.shape[0]
    if tangent(features.first, features.second, features.slack, u, at[0] - p[0], at[1] - p[1], at[2] - p[2]):
        found = blocker(space, p, at, guess)
    views[point, u] = SEEN if found < 0 else HIDDEN
    return found
