"""Compiled search for shortest paths over features, from one point to one or to several.

Most blocked flights need a small detour: `within_ellipse` looks only at the features in an ellipse around the
straight flight, and a path it finds is shortest because any way that leaves the ellipse is longer. What is left
goes to `shortest`, one search over all features to all remaining targets, which remembers what features see.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, INTEGERS_1, compiled_for, writable
from flockopt.geometry.free_space import FreeSpace
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import Features
from flockopt.travel.blocking import blocker
from flockopt.travel.sight import HIDDEN, SEEN, UNKNOWN, Sight, look_around, sees, tangent, wraps

__all__ = ["shortest", "within_ellipse"]

#: More features than this in an ellipse, or more of them settled, and the pair is left to the wider search.
MOST_MEMBERS, MOST_SETTLED = 256, 48


@njit(cache=True, error_model="numpy")
def within_ellipse(
    space: FreeSpace, features: Features, points: FloatArray, views: NDArray[np.uint8], source: int, target: int,
    from_source: FloatArray, bound: float, parent: NDArray[np.int64],
) -> tuple[float, int]:  # fmt: skip
    """A shortest path over features v with ``|source v| + |v target| < bound``.

    Args:
        space: What segments are checked against.
        features: Where paths may bend.
        points: (P, 3) m.
        views: (P, F) what each point is known to see; filled further here.
        source: Index of the point to start from.
        target: Index of the point to reach.
        from_source: (F,) m, distance of each feature from the source.
        bound: Metres.
        parent: (F,) the feature before each settled feature, -1 if it is reached from the source.

    Returns:
        Its length and last feature; (inf, -1) if there is none shorter than ``bound`` or it is not found soon.
    """
    position, first, second, slack = features.position, features.first, features.second, features.slack
    members = np.empty(MOST_MEMBERS, dtype=np.int64)
    to_target, distance, settled = np.empty(MOST_MEMBERS), np.empty(MOST_MEMBERS), np.zeros(MOST_MEMBERS, dtype=np.bool_)
    start, goal, at, there = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for axis in range(3):
        start[axis], goal[axis] = points[source, axis], points[target, axis]
    size = 0
    for v in range(position.shape[0]):
        if from_source[v] >= bound:
            continue
        away = (position[v, 0] - goal[0]) ** 2 + (position[v, 1] - goal[1]) ** 2 + (position[v, 2] - goal[2]) ** 2
        rest = bound - from_source[v]
        if away < rest * rest:
            if size == MOST_MEMBERS:
                return np.inf, -1
            members[size], to_target[size] = v, math.sqrt(away)
            known = views[source, v]
            # a feature not known to be hidden from the source may be as near as the straight line
            distance[size] = np.inf if known == HIDDEN else from_source[v]
            parent[v] = -1
            size += 1
    best, last = bound, -1
    guess = -1
    for _ in range(MOST_SETTLED):
        nearest, key = -1, best
        for m in range(size):
            if not settled[m] and distance[m] + to_target[m] < key:
                nearest, key = m, distance[m] + to_target[m]
        if nearest < 0:
            return (best, last) if last >= 0 else (np.inf, -1)
        u = members[nearest]
        at[0], at[1], at[2] = position[u, 0], position[u, 1], position[u, 2]
        if parent[u] < 0 and views[source, u] == UNKNOWN:
            found = sees(space, features, views, source, start, u, at, guess)
            if found >= 0:
                distance[nearest] = np.inf
                guess = found if found < space.table.shape[0] else guess
                continue
        settled[nearest] = True
        if parent[u] < 0:
            i0, i1, i2 = at[0] - start[0], at[1] - start[1], at[2] - start[2]
        else:
            w = parent[u]
            i0, i1, i2 = at[0] - position[w, 0], at[1] - position[w, 1], at[2] - position[w, 2]
        o0, o1, o2 = goal[0] - at[0], goal[1] - at[1], goal[2] - at[2]
        ends = wraps(first, second, features.bend, u, i0, i1, i2, o0, o1, o2)
        if ends and sees(space, features, views, target, goal, u, at, guess) < 0:
            best, last = key, u
            continue
        for m in range(size):
            if settled[m]:
                continue
            v = members[m]
            o0, o1, o2 = position[v, 0] - at[0], position[v, 1] - at[1], position[v, 2] - at[2]
            length = distance[nearest] + math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
            if length + to_target[m] >= best or (distance[m] <= length and views[source, v] != UNKNOWN):
                continue
            if not (tangent(first, second, slack, u, o0, o1, o2) and tangent(first, second, slack, v, o0, o1, o2)):
                continue
            if not wraps(first, second, features.bend, u, i0, i1, i2, o0, o1, o2):
                continue
            there[0], there[1], there[2] = position[v, 0], position[v, 1], position[v, 2]
            if parent[v] < 0 and views[source, v] == UNKNOWN:
                if sees(space, features, views, source, start, v, there, guess) < 0:
                    continue
                distance[m] = np.inf
            elif parent[v] < 0 and views[source, v] == SEEN:
                continue
            found = blocker(space, at, there, guess)
            if found < 0:
                distance[m], parent[v] = length, u
            else:
                guess = found
    return np.inf, -1


@compiled_for(writable(INTEGERS_1), writable(INTEGERS_1), FLOATS_1, types.int64, error_model="numpy")
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


@compiled_for(writable(INTEGERS_1), writable(INTEGERS_1), FLOATS_1, types.int64, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def shortest(
    space: FreeSpace, features: Features, sight: Sight, points: FloatArray, views: NDArray[np.uint8],
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
    position, first, second = features.position, features.first, features.second
    num_features, num_obstacles = position.shape[0], space.table.shape[0]
    distance = np.full(num_features, np.inf)
    estimate = np.zeros(num_features)
    key = np.empty(num_features)
    heap = np.empty(num_features, dtype=np.int64)
    place = np.full(num_features, -1, dtype=np.int64)  # -1 never met, -2 settled
    start, at, goal = np.empty(3), np.empty(3), np.empty(3)
    goals = np.empty((targets.shape[0], 3))
    for axis in range(3):
        start[axis] = points[source, axis]
        for t in range(targets.shape[0]):
            goals[t, axis] = points[targets[t], axis]
    size = 0
    worst = best.max()
    guess = -1
    for v in range(num_features):
        at[0], at[1], at[2] = position[v, 0], position[v, 1], position[v, 2]
        near = np.inf
        for t in range(goals.shape[0]):
            near = min(near, (at[0] - goals[t, 0]) ** 2 + (at[1] - goals[t, 1]) ** 2 + (at[2] - goals[t, 2]) ** 2)
        estimate[v] = math.sqrt(near)
        length = segment_length(start, at)
        if length + estimate[v] >= worst:
            continue
        found = sees(space, features, views, source, start, v, at, guess)
        if found < 0:
            distance[v], parent[v], key[v] = length, -1, length + estimate[v]
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
        x, y, z, so_far = position[u, 0], position[u, 1], position[u, 2], distance[u]
        at[0], at[1], at[2] = x, y, z
        if parent[u] < 0:
            i0, i1, i2 = x - start[0], y - start[1], z - start[2]
        else:
            i0, i1, i2 = x - position[parent[u], 0], y - position[parent[u], 1], z - position[parent[u], 2]
        useful, improved = False, False
        for t in range(goals.shape[0]):
            o0, o1, o2 = goals[t, 0] - x, goals[t, 1] - y, goals[t, 2] - z
            length = so_far + math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
            if length < best[t]:
                useful = True
                if wraps(first, second, features.bend, u, i0, i1, i2, o0, o1, o2):
                    goal[0], goal[1], goal[2] = goals[t, 0], goals[t, 1], goals[t, 2]
                    if sees(space, features, views, targets[t], goal, u, at, -1) < 0:
                        best[t], last[t] = length, u
                        improved = True
        if improved:
            worst = best.max()
        if not useful:
            continue
        if sight.begin[u] < 0:
            sight = look_around(space, features, sight, u)
        pool = sight.pool
        for entry in range(sight.begin[u], sight.end[u]):
            v = pool[entry]
            if place[v] == -2:
                continue
            o0, o1, o2 = position[v, 0] - x, position[v, 1] - y, position[v, 2] - z
            length = so_far + math.sqrt(o0 * o0 + o1 * o1 + o2 * o2)
            if length >= distance[v] or length + estimate[v] >= worst:
                continue
            if wraps(first, second, features.bend, u, i0, i1, i2, o0, o1, o2):
                distance[v], parent[v], key[v] = length, u, length + estimate[v]
                if place[v] < 0:
                    place[v] = size
                    heap[size] = v
                    size += 1
                _rise(heap, place, key, place[v])
    return sight
