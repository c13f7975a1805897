"""Compiled shortening of clear polylines: bends slide, retract and vanish as far as the obstacles let them."""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_2, INTEGERS_1, INTEGERS_2, compiled_for, compiled_lazily, writable
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace, may_meet
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray
from flockopt.travel.blocking import blocker

__all__ = ["shorten"]

#: Rounds over all bends, and halvings in one search for how far a bend may retract, at most.
MOST_ROUNDS, MOST_HALVINGS = 6, 20
#: A gain of less than this share of the length is not worth a round.
LEAST_GAIN = 1e-4
#: How much of the way to an even climb, or to a bend's best place, is tried, in this order.
SHARES = (1.0, 0.5, 0.25)


@compiled_for(
    FREE_SPACE, FLOATS_2, INTEGERS_2, INTEGERS_1, writable(INTEGERS_1), writable(FLOATS_2), writable(FLOATS_2),
    error_model="numpy",
)  # fmt: skip
def shorten(
    space: FreeSpace, points: FloatArray, pairs: NDArray[np.int64], begin: NDArray[np.int64], count: NDArray[np.int64],
    bends: FloatArray, along: FloatArray,
) -> FloatArray:  # fmt: skip
    """Shorten clear polylines between pairs of points in place; they stay clear and never get longer.

    Args:
        space: Obstacles, needs and bounds.
        points: (P, 3) m.
        pairs: (L, 2) from, to.
        begin: (L,) where each pair's bends begin.
        count: (L,) how many bends there are, negative where there is no polyline; lowered here.
        bends: (B, 3) m.
        along: (B, 3) for each bend the unit direction of the edge it is around, zero where none.

    Returns:
        (L,) m, infinite where there is no polyline.
    """
    lengths = np.full(pairs.shape[0], np.inf)
    most = 0
    for leg in range(pairs.shape[0]):
        most = max(most, count[leg])
    path, edges = np.zeros((most + 2, 3)), np.zeros((most + 2, 3))
    for leg in range(pairs.shape[0]):
        if count[leg] < 0:
            continue
        size, first = count[leg] + 2, begin[leg]
        for axis in range(3):
            path[0, axis], path[size - 1, axis] = points[pairs[leg, 0], axis], points[pairs[leg, 1], axis]
            for i in range(1, size - 1):
                path[i, axis], edges[i, axis] = bends[first + i - 1, axis], along[first + i - 1, axis]
        size = _shorten_one(space, path, edges, size)
        lengths[leg], count[leg] = _length(path, size), size - 2
        for axis in range(3):
            for i in range(1, size - 1):
                bends[first + i - 1, axis], along[first + i - 1, axis] = path[i, axis], edges[i, axis]
    return lengths


@compiled_lazily(error_model="numpy")
def _shorten_one(space: FreeSpace, path: FloatArray, edges: FloatArray, size: int) -> int:
    """Shorten the polyline of the first ``size`` vertices; return how many are left."""
    local = _nearby(space, path, size)
    length = np.inf
    for _ in range(MOST_ROUNDS):
        size = _skip(local, path, edges, size)
        shorter = _length(path, size)
        if length - shorter <= LEAST_GAIN * shorter:
            break
        length = shorter
        first = 0
        for i in range(1, size):
            if i == size - 1 or abs(edges[i, 2]) < 1.0 - 1e-9:
                if i - first > 1:
                    _level(local, path, first, i)
                first = i
        for i in range(1, size - 1):
            _slide(local, path, edges, i)
            for side in range(-1, 2, 2):
                _retract(local, path, i, i + side, i - side, 0.5 * LEAST_GAIN * length)
    return size


@compiled_lazily(error_model="numpy")
def _length(path: FloatArray, size: int) -> float:
    total = 0.0
    for i in range(size - 1):
        total += segment_length(path[i], path[i + 1])
    return total


@compiled_lazily(error_model="numpy")
def _nearby(space: FreeSpace, path: FloatArray, size: int) -> FreeSpace:
    """The obstacles that the polyline's bounding box meets: shortening never leaves that box."""
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(size):
        for axis in range(3):
            lower[axis], upper[axis] = min(lower[axis], path[i, axis]), max(upper[axis], path[i, axis])
    kept, num_kept = np.empty(space.table.shape[0], dtype=np.int64), 0
    for k in range(space.table.shape[0]):
        if may_meet(space, k, lower, upper):
            kept[num_kept] = k
            num_kept += 1
    kept = kept[:num_kept]
    return FreeSpace(space.table[kept], space.boxes[kept], space.needs[kept], space.reach[kept], space.lower, space.upper)


@compiled_lazily(error_model="numpy")
def _skip(space: FreeSpace, path: FloatArray, edges: FloatArray, size: int) -> int:
    """Remove bends whose neighbours see each other; return the new size."""
    i = 1
    guess = -1
    while i < size - 1:
        guess = blocker(space, path[i - 1], path[i + 1], guess)
        if guess < 0:
            for j in range(i, size - 1):
                for axis in range(3):
                    path[j, axis], edges[j, axis] = path[j + 1, axis], edges[j + 1, axis]
            size -= 1
            i = max(i - 1, 1)
        else:
            i += 1
    return size


@compiled_for(FREE_SPACE, writable(FLOATS_2), types.int64, types.int64, error_model="numpy")
def _level(space: FreeSpace, path: FloatArray, first: int, last: int) -> None:
    """Let the path climb evenly from vertex ``first`` to vertex ``last``, between which all edges are upright.

    Unrolled about upright edges the shortest path is straight: height grows with the horizontal way flown.
    """
    whole = 0.0
    for i in range(first, last):
        whole += math.hypot(path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1])
    if whole <= 0.0:
        return
    heights = np.empty(last + 1 - first)
    before, after = np.empty(3), np.empty(3)
    for share in SHARES:
        way, clear = 0.0, True
        heights[0] = path[first, 2]
        for axis in range(3):
            after[axis] = path[first, axis]
        for i in range(first + 1, last + 1):
            for axis in range(3):
                before[axis], after[axis] = after[axis], path[i, axis]
            way += math.hypot(after[0] - before[0], after[1] - before[1])
            even = path[first, 2] + (path[last, 2] - path[first, 2]) * way / whole
            after[2] = path[i, 2] if i == last else path[i, 2] + share * (even - path[i, 2])
            heights[i - first] = after[2]
            clear = clear and blocker(space, before, after, -1) < 0
        if clear:
            for i in range(first + 1, last):
                path[i, 2] = heights[i - first]
            break


@compiled_lazily(error_model="numpy")
def _slide(space: FreeSpace, path: FloatArray, edges: FloatArray, i: int) -> None:
    """Move bend i along its edge to where the path is shortest, or as far that way as is clear.

    Unfolded about the edge, the neighbours' ends are on one plane, and the shortest path crosses the edge where
    the straight line between them does.
    """
    s1, s2, r1, r2 = 0.0, 0.0, 0.0, 0.0
    for axis in range(3):
        s1 += (path[i - 1, axis] - path[i, axis]) * edges[i, axis]
        s2 += (path[i + 1, axis] - path[i, axis]) * edges[i, axis]
    for axis in range(3):
        r1 += (path[i - 1, axis] - path[i, axis] - s1 * edges[i, axis]) ** 2
        r2 += (path[i + 1, axis] - path[i, axis] - s2 * edges[i, axis]) ** 2
    r1, r2 = math.sqrt(r1), math.sqrt(r2)
    shift = s1 + (s2 - s1) * r1 / (r1 + r2) if r1 + r2 > 0.0 else 0.0
    moved = np.empty(3)
    if shift != 0.0:
        length = segment_length(path[i - 1], path[i]) + segment_length(path[i], path[i + 1])
        for share in SHARES:
            clear = True
            for axis in range(3):
                moved[axis] = path[i, axis] + share * shift * edges[i, axis]
                clear = clear and space.lower[axis] <= moved[axis] <= space.upper[axis]
            clear = clear and segment_length(path[i - 1], moved) + segment_length(moved, path[i + 1]) < length
            for side in range(-1, 2, 2):
                clear = clear and blocker(space, path[i + side], moved, -1) < 0
            if clear:
                for axis in range(3):
                    path[i, axis] = moved[axis]
                break


@compiled_lazily(error_model="numpy")
def _retract(space: FreeSpace, path: FloatArray, i: int, toward: int, away: int, least_gain: float) -> None:
    """Move bend i along its own segment to ``toward`` until the other segment touches an obstacle.

    The one segment stays on its line, hence clear, and by the triangle inequality the path gets no longer. The
    length is a convex function of how far the bend has moved, so its slope at a clear place bounds what more
    there is to gain; less than ``least_gain`` metres is left alone.
    """
    start, moved, end = np.empty(3), np.empty(3), np.empty(3)
    for axis in range(3):
        start[axis], moved[axis], end[axis] = path[i, axis], path[i, axis], path[away, axis]
    whole = segment_length(start, path[toward])
    low, high = 0.0, 1.0
    guess = -1
    for _ in range(MOST_HALVINGS):
        onward = segment_length(path[i], end)
        ahead = 0.0
        for axis in range(3):
            ahead += (path[toward, axis] - start[axis]) * (end[axis] - path[i, axis])
        # one plus the cosine between the two segments: zero where the path is straight
        if (high - low) * whole * (1.0 + ahead / max(whole * onward, 1e-300)) <= least_gain:
            break
        middle = 0.5 * (low + high)
        for axis in range(3):
            moved[axis] = start[axis] + middle * (path[toward, axis] - start[axis])
        guess = blocker(space, moved, end, guess)
        if guess < 0:
            low = middle
            for axis in range(3):
                path[i, axis] = moved[axis]
        else:
            high = middle
