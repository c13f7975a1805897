"""Compiled search for shortest paths over features: what sees what, found only as far as the search gets."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flockopt.features import Features, Space
from flockopt.geometry import FloatArray
from flockopt.kernels import SEGMENT_TOLERANCE_M, segment_distance, segment_near_box

__all__ = ["Sight", "blocker", "empty_sight", "segment_length", "shortest"]

#: How far, as a sine, a bend may turn away from the obstacle it wraps.
BEND_SLACK = 0.3
UNKNOWN, SEEN, HIDDEN = 0, 1, 2


class Sight(NamedTuple):
    """Which features see each other, as far as anyone asked: a pool of sorted lists, one per feature."""

    pool: NDArray[np.int32]  # (room,) feature indices
    begin: NDArray[np.int64]  # (F,) where a feature's list begins in the pool, -1 if nobody asked
    end: NDArray[np.int64]  # (F,)
    used: NDArray[np.int64]  # (1,) filled part of the pool


def empty_sight(num_features: int) -> Sight:
    """Nothing known yet."""
    return Sight(
        np.empty(max(16 * num_features, 64), dtype=np.int32),
        np.full(num_features, -1, dtype=np.int64),
        np.zeros(num_features, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
    )


@njit(cache=True)
def segment_length(p: FloatArray, q: FloatArray) -> float:
    """Metres."""
    return math.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2)


@njit(cache=True)
def blocker(space: Space, p: FloatArray, q: FloatArray, guess: int) -> int:
    """An obstacle the segment p-q comes too near to, or -1; ``guess`` (or -1) is tried first."""
    table, grown, needs = space.table, space.grown, space.needs
    if guess >= 0 and segment_near_box(grown[guess], 0.0, p, q):
        need = needs[guess]
        if segment_distance(table[guess], p, q, need, need - 1e-12) < need - SEGMENT_TOLERANCE_M:
            return guess
    for k in range(table.shape[0]):
        if k != guess and segment_near_box(grown[k], 0.0, p, q):
            need = needs[k]
            if segment_distance(table[k], p, q, need, need - 1e-12) < need - SEGMENT_TOLERANCE_M:
                return k
    return -1


@njit(cache=True)
def _tangent(features: Features, u: int, d0: float, d1: float, d2: float) -> bool:
    """Whether a line of direction d through feature u stays out of the prism there."""
    a = d0 * features.first[u, 0] + d1 * features.first[u, 1] + d2 * features.first[u, 2]
    b = d0 * features.second[u, 0] + d1 * features.second[u, 1] + d2 * features.second[u, 2]
    return a * b <= features.slack[u] * (d0 * d0 + d1 * d1 + d2 * d2)


@njit(cache=True)
def _wraps(features: Features, u: int, before: FloatArray, after: FloatArray) -> bool:
    """Whether the bend before-u-after is around the obstacle of u, not away from it."""
    at = features.position[u]
    come, go = segment_length(before, at), segment_length(at, after)
    if come == 0.0 or go == 0.0:
        return True
    a, b = 0.0, 0.0
    for axis in range(3):
        turn = (after[axis] - at[axis]) / go - (at[axis] - before[axis]) / come
        a += turn * features.first[u, axis]
        b += turn * features.second[u, axis]
    return a <= BEND_SLACK and b <= BEND_SLACK


@njit(cache=True)
def _knows(sight: Sight, v: int, u: int) -> bool:
    """Whether u stands in the list of v."""
    low, high = sight.begin[v], sight.end[v]
    while low < high:
        middle = (low + high) // 2
        if sight.pool[middle] < u:
            low = middle + 1
        else:
            high = middle
    return low < sight.end[v] and sight.pool[low] == u


@njit(cache=True)
def _look_around(space: Space, features: Features, sight: Sight, u: int) -> Sight:
    """Fill the list of feature u: every feature it sees along a line tangent at both."""
    pool, used = sight.pool, sight.used[0]
    position = features.position
    sight.begin[u] = used
    at = position[u]
    guess = -1
    for v in range(position.shape[0]):
        if v == u:
            continue
        if sight.begin[v] >= 0:
            clear = _knows(sight, v, u)
        else:
            d0, d1, d2 = position[v, 0] - at[0], position[v, 1] - at[1], position[v, 2] - at[2]
            if not (_tangent(features, u, d0, d1, d2) and _tangent(features, v, d0, d1, d2)):
                continue
            found = blocker(space, at, position[v], guess)
            clear = found < 0
            guess = guess if clear else found
        if clear:
            if used == pool.shape[0]:
                wider = np.empty(2 * used, dtype=np.int32)
                wider[:used] = pool
                pool = wider
            pool[used] = v
            used += 1
    sight.end[u] = used
    sight.used[0] = used
    return Sight(pool, sight.begin, sight.end, sight.used)


@njit(cache=True)
def _rise(heap: NDArray[np.int64], place: NDArray[np.int64], key: FloatArray, at: int) -> None:
    """Move the entry at heap position ``at`` up to where it belongs."""
    v = heap[at]
    while at > 0:
        above = (at - 1) // 2
        if key[heap[above]] <= key[v]:
            break
        heap[at] = heap[above]
        place[heap[at]] = at
        at = above
    heap[at] = v
    place[v] = at


@njit(cache=True)
def _pop(heap: NDArray[np.int64], place: NDArray[np.int64], key: FloatArray, size: int) -> int:
    """Take the least entry out of a heap of ``size``; it is marked -2 in ``place``."""
    top = heap[0]
    place[top] = -2
    size -= 1
    if size > 0:
        v = heap[size]
        at = 0
        while True:
            child = 2 * at + 1
            if child >= size:
                break
            if child + 1 < size and key[heap[child + 1]] < key[heap[child]]:
                child += 1
            if key[heap[child]] >= key[v]:
                break
            heap[at] = heap[child]
            place[heap[at]] = at
            at = child
        heap[at] = v
        place[v] = at
    return top


@njit(cache=True)
def _sees(
    space: Space, features: Features, points: FloatArray, views: NDArray[np.uint8], point: int, u: int, guess: int
) -> int:
    """-1 if the point sees feature u along a line tangent there; else what blocks it (K if not tangent)."""
    known = views[point, u]
    if known == SEEN:
        return -1
    if known == HIDDEN:
        return space.table.shape[0]
    p, at = points[point], features.position[u]
    found = space.table.shape[0]
    if _tangent(features, u, at[0] - p[0], at[1] - p[1], at[2] - p[2]):
        found = blocker(space, p, at, guess)
    views[point, u] = SEEN if found < 0 else HIDDEN
    return found


@njit(cache=True)
def shortest(
    space: Space, features: Features, sight: Sight, points: FloatArray, views: NDArray[np.uint8],
    source: int, targets: NDArray[np.int64], best: FloatArray, last: NDArray[np.int64], parent: NDArray[np.int64],
) -> Sight:  # fmt: skip
    """Shortest paths from one point to several, over features.

    A* with the distance to the nearest target as the estimate; a feature is expanded only if a path through it
    could still beat the best known one to some target.

    Args:
        space: What segments are checked against.
        features: Where paths may bend.
        sight: What is known of who sees whom; filled further here.
        points: (P, 3) m.
        views: (P, F) what each point is known to see; filled further here.
        source: Index of the point to start from.
        targets: (T,) indices of the points to reach.
        best: (T,) m, upper bounds on the lengths (infinite where none is known); lowered here.
        last: (T,) the last feature before each target; left as it is where no shorter path is found.
        parent: (F,) the feature before each settled feature, -1 if it is reached from the source.

    Returns:
        The sight, with its pool grown where needed.
    """
    position = features.position
    num_features, num_obstacles = position.shape[0], space.table.shape[0]
    distance = np.full(num_features, np.inf)
    estimate = np.zeros(num_features)
    key = np.empty(num_features)
    heap = np.empty(num_features, dtype=np.int64)
    place = np.full(num_features, -1, dtype=np.int64)  # -1 never met, -2 settled
    size = 0
    worst = best.max()
    guess = -1
    for v in range(num_features):
        near = np.inf
        for t in range(targets.shape[0]):
            near = min(near, segment_length(position[v], points[targets[t]]))
        estimate[v] = near
        length = segment_length(points[source], position[v])
        if length + near >= worst:
            continue
        found = _sees(space, features, points, views, source, v, guess)
        if found < 0:
            distance[v], parent[v], key[v] = length, -1, length + near
            heap[size] = v
            _rise(heap, place, key, size)
            size += 1
        elif found < num_obstacles:
            guess = found
    while size > 0:
        u = _pop(heap, place, key, size)
        size -= 1
        if key[u] >= worst:
            break
        before = points[source] if parent[u] < 0 else position[parent[u]]
        useful, improved = False, False
        for t in range(targets.shape[0]):
            target = points[targets[t]]
            length = distance[u] + segment_length(position[u], target)
            if length < best[t]:
                useful = True
                if _wraps(features, u, before, target) and _sees(space, features, points, views, targets[t], u, -1) < 0:
                    best[t], last[t] = length, u
                    improved = True
        if improved:
            worst = best.max()
        if not useful:
            continue
        if sight.begin[u] < 0:
            sight = _look_around(space, features, sight, u)
        for entry in range(sight.begin[u], sight.end[u]):
            v = sight.pool[entry]
            if place[v] == -2:
                continue
            length = distance[u] + segment_length(position[u], position[v])
            if length < distance[v] and length + estimate[v] < worst and _wraps(features, u, before, position[v]):
                distance[v], parent[v], key[v] = length, u, length + estimate[v]
                if place[v] < 0:
                    place[v] = size
                    heap[size] = v
                    size += 1
                _rise(heap, place, key, place[v])
    return sight
