"""Compiled shortening of a clear polyline: bends slide, retract and vanish as far as the obstacles let them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from flockopt.geometry import SPHERE, FloatArray
from flockopt.nearness import Space, blocker
from flockopt.visibility import segment_length

__all__ = ["polyline_length", "shorten"]

#: Rounds over all bends, and halvings in one search for how far a bend may retract, at most.
MOST_ROUNDS, MOST_HALVINGS = 5, 20
#: A gain of less than this share of the length is not worth a round.
LEAST_GAIN = 1e-4
#: How much of the way to an even climb is tried, in this order.
LEVEL_SHARES = (1.0, 0.5, 0.25)


@njit(cache=True)
def polyline_length(path: FloatArray, count: int) -> float:
    """Length of the first ``count`` vertices, metres."""
    total = 0.0
    for i in range(count - 1):
        total += segment_length(path[i], path[i + 1])
    return total


@njit(cache=True)
def nearby(space: Space, path: FloatArray, count: int) -> Space:
    """The part of the space that the polyline's bounding box meets: shortening never leaves that box."""
    lower, upper = path[0].copy(), path[0].copy()
    for i in range(1, count):
        for axis in range(3):
            lower[axis], upper[axis] = min(lower[axis], path[i, axis]), max(upper[axis], path[i, axis])
    keep = np.empty(space.table.shape[0], dtype=np.int64)
    size = 0
    for k in range(space.table.shape[0]):
        meets = True
        for axis in range(3):
            room = space.table[k, 6] + space.needs[k] if axis == 2 and space.table[k, 0] != SPHERE else space.reach[k]
            place = space.table[k, 1 + axis]
            meets = meets and lower[axis] <= place + room and upper[axis] >= place - room
        if meets:
            keep[size] = k
            size += 1
    keep = keep[:size]
    return Space(space.table[keep], space.needs[keep], space.reach[keep], space.lower, space.upper)


@njit(cache=True)
def _drop(path: FloatArray, along: FloatArray, count: int, i: int) -> None:
    for j in range(i, count - 1):
        path[j], along[j] = path[j + 1], along[j + 1]


@njit(cache=True)
def _skip(space: Space, path: FloatArray, along: FloatArray, count: int) -> int:
    """Remove bends whose neighbours see each other; return the new count."""
    i = 1
    guess = -1
    while i < count - 1:
        guess = blocker(space, path[i - 1], path[i + 1], guess)
        if guess < 0:
            _drop(path, along, count, i)
            count -= 1
            i = max(i - 1, 1)
        else:
            i += 1
    return count


@njit(cache=True)
def _slide(space: Space, path: FloatArray, along: FloatArray, i: int) -> None:
    """Move bend i along its edge to where the path is shortest, or as far that way as is clear.

    Unfolded about the edge, the neighbours' ends are on one plane, and the shortest path crosses the edge where
    the straight line between them does.
    """
    a, v, b, edge = path[i - 1], path[i], path[i + 1], along[i]
    s1, s2, r1, r2 = 0.0, 0.0, 0.0, 0.0
    for axis in range(3):
        s1 += (a[axis] - v[axis]) * edge[axis]
        s2 += (b[axis] - v[axis]) * edge[axis]
    for axis in range(3):
        r1 += (a[axis] - v[axis] - s1 * edge[axis]) ** 2
        r2 += (b[axis] - v[axis] - s2 * edge[axis]) ** 2
    r1, r2 = math.sqrt(r1), math.sqrt(r2)
    if r1 + r2 <= 0.0:
        return
    shift = s1 + (s2 - s1) * r1 / (r1 + r2)
    moved = np.empty(3)
    for _ in range(4):
        inside = True
        for axis in range(3):
            moved[axis] = v[axis] + shift * edge[axis]
            inside = inside and space.lower[axis] <= moved[axis] <= space.upper[axis]
        gain = segment_length(a, v) + segment_length(v, b) - segment_length(a, moved) - segment_length(moved, b)
        if gain <= 0.0:
            return
        if inside and blocker(space, a, moved, -1) < 0 and blocker(space, moved, b, -1) < 0:
            path[i] = moved
            return
        shift *= 0.5


@njit(cache=True)
def _level(space: Space, path: FloatArray, first: int, last: int) -> None:
    """Let the path climb evenly from vertex ``first`` to vertex ``last``, between which all edges are upright.

    Unrolled about upright edges the shortest path is straight: height grows with the horizontal way flown.
    """
    moved = path[first : last + 1].copy()
    way = np.zeros(last + 1 - first)
    for i in range(1, last + 1 - first):
        way[i] = way[i - 1] + math.hypot(moved[i, 0] - moved[i - 1, 0], moved[i, 1] - moved[i - 1, 1])
    if way[-1] <= 0.0:
        return
    even = moved[0, 2] + (moved[-1, 2] - moved[0, 2]) * way / way[-1]
    for share in LEVEL_SHARES:
        clear = True
        for i in range(1, last + 1 - first):
            moved[i, 2] = path[first + i, 2] + share * (even[i] - path[first + i, 2])
            clear = clear and blocker(space, moved[i - 1], moved[i], -1) < 0
        if clear:
            path[first : last + 1] = moved
            return


@njit(cache=True)
def _level_runs(space: Space, path: FloatArray, along: FloatArray, count: int) -> None:
    """`_level` every longest run of bends around upright edges."""
    first = 0
    for i in range(1, count):
        if i == count - 1 or abs(along[i, 2]) < 1.0 - 1e-9:
            if i - first > 1:
                _level(space, path, first, i)
            first = i


@njit(cache=True)
def _retract(space: Space, path: FloatArray, i: int, toward: int, away: int, least_gain: float) -> None:
    """Move bend i along its own segment to ``toward`` until the other segment touches an obstacle.

    The one segment stays on its line, hence clear, and by the triangle inequality the path gets no longer. The
    length is a convex function of how far the bend has moved, so its slope at a clear place bounds what more
    there is to gain; less than ``least_gain`` metres is left alone.
    """
    v, goal, end = path[i].copy(), path[toward].copy(), path[away].copy()
    moved = v.copy()
    whole = segment_length(v, goal)
    low, high = 0.0, 1.0
    guess = -1
    for _ in range(MOST_HALVINGS):
        onward = segment_length(path[i], end)
        ahead = 0.0
        for axis in range(3):
            ahead += (goal[axis] - v[axis]) * (end[axis] - path[i, axis])
        # cosine of the angle between the two segments: -1 where the path is straight
        if (high - low) * whole * (1.0 + ahead / max(whole * onward, 1e-300)) <= least_gain:
            return
        middle = 0.5 * (low + high)
        for axis in range(3):
            moved[axis] = v[axis] + middle * (goal[axis] - v[axis])
        found = blocker(space, moved, end, guess)
        if found < 0:
            low = middle
            path[i, 0], path[i, 1], path[i, 2] = moved[0], moved[1], moved[2]
        else:
            high, guess = middle, found


@njit(cache=True)
def shorten(space: Space, path: FloatArray, along: FloatArray, count: int) -> int:
    """Shorten a clear polyline in place; it stays clear and never gets longer.

    Args:
        space: Obstacles, needs and bounds.
        path: (room, 3) m, the first ``count`` rows are the polyline.
        along: (room, 3) for each vertex the unit direction of the edge it bends around, zero where none.
        count: Number of vertices.

    Returns:
        The new number of vertices.
    """
    local = nearby(space, path, count)
    count = _skip(local, path, along, count)
    length = polyline_length(path, count)
    for _ in range(MOST_ROUNDS):
        least_gain = LEAST_GAIN * length
        _level_runs(local, path, along, count)
        for i in range(1, count - 1):
            _slide(local, path, along, i)
            _retract(local, path, i, i - 1, i + 1, 0.5 * least_gain)
            _retract(local, path, i, i + 1, i - 1, 0.5 * least_gain)
        count = _skip(local, path, along, count)
        shorter = polyline_length(path, count)
        if length - shorter <= least_gain:
            break
        length = shorter
    return count
