"""Where shortest paths bend: points on the edges of obstacles grown by what a drone needs.

A shortest path among convex obstacles is straight except where it wraps an edge. The edges of `flockopt.travel.edges` are
sampled where they are free of every other obstacle, and a sphere gets a net of single points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, compiled_for, compiled_lazily, record_of
from flockopt.geometry.distances import HALF_X, SHAPE, SPHERE, X
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace, inside, may_meet
from flockopt.geometry.kernels import point_distance, point_gradient, segment_length
from flockopt.records.arrays import FloatArray
from flockopt.travel.edges import CORE, ENDS_BEND, FIRST, FROM, OWNER, ROUND, SECOND, TO, feature_edges, room_for_row

__all__ = ["FEATURES", "Features", "ball_features", "make_features"]

#: Most samples on the inner part of one free stretch of an edge.
MOST_SAMPLES = 3
#: A stretch of edge gets one more sample for each of these fractions of the space's longest side.
SPACING_SHARE = 1.0 / 12.0
#: Shorter free stretches are too narrow to be worth a sample, metres.
LEAST_STRETCH_M = 1e-6
#: How far, as the product of two sines, an edge may be from tangent at a feature and still be of use.
EDGE_SLACK, UNDERSIDE_SLACK, SPHERE_SLACK = 1e-10, 0.03, 0.25
#: Among so few features it is never less than this: a line may cut a prism's corner and clear what is rounder inside.
FEW_FEATURES, CUT_SLACK = 380, 0.25

#: Where a feature's columns begin while features are made: see `Features`.
POSITION, NORMAL, OTHER_NORMAL, ALONG, INWARD, ROOM, SLACK, BACK, ONWARD, CAP, BESIDE = 0, 3, 6, 9, 12, 15, 16, 17, 18, 19, 20
NUM_FEATURE_COLUMNS = 21
#: Points around a sphere: three rings of eight, and its poles.
NET_NODES = 26


class Features(NamedTuple):
    """Points where a path may bend, with the two faces that meet there and the round core that it winds around."""

    position: FloatArray  # (F, 3) m
    first: FloatArray  # (F, 3) outward normal of one face
    second: FloatArray  # (F, 3) outward normal of the other face
    along: FloatArray  # (F, 3) unit direction of the edge; zero on a sphere
    core: FloatArray  # (F, 3) m, a point of the core: of a line along the edge, or a sphere's centre
    room: FloatArray  # (F,) m, how far from the core paths keep; 0 where there is none
    slack: FloatArray  # (F,) see EDGE_SLACK
    back: FloatArray  # (F,) m, where the free stretch of the edge begins: along it, from the position, not positive
    onward: FloatArray  # (F,) m, where it ends
    cap: FloatArray  # (F,) 1 on the upper corner of a prism, whose top is a third face; -1 on a lower one; else NaN
    owner: NDArray[np.int64]  # (F,) the obstacle it is beside; the number of obstacles where it is between two
    prism: NDArray[np.int64]  # (F,) the obstacle that tangents there are clear of, -1 where none is


#: The same as compiled code knows it.
FEATURES = record_of(Features, *[FLOATS_2] * 5, *[FLOATS_1] * 5, INTEGERS_1, INTEGERS_1)


def make_features(space: FreeSpace) -> Features:
    """All features of a space, in the order of its obstacles."""
    spacing = SPACING_SHARE * float((space.upper - space.lower).max())
    return _features(_sample(space, feature_edges(space), spacing), len(space.table))


def ball_features(space: FreeSpace, first: int) -> Features:
    """The features of the spheres among a space's obstacles from the ``first`` on."""
    return _features(_sample_spheres(space, first), len(space.table))


def _features(rows: FloatArray, num_obstacles: int) -> Features:
    position, first, second, along, inward = (
        np.ascontiguousarray(rows[:, column : column + 3]) for column in (POSITION, NORMAL, OTHER_NORMAL, ALONG, INWARD)
    )
    room, slack, back, onward, cap = (np.ascontiguousarray(rows[:, column]) for column in (ROOM, SLACK, BACK, ONWARD, CAP))
    if len(rows) <= FEW_FEATURES:
        slack = np.maximum(slack, CUT_SLACK)
    owner = rows[:, BESIDE].astype(np.int64)
    prism = np.where((owner < num_obstacles) & (slack <= EDGE_SLACK), owner, -1)
    return Features(position, first, second, along, position + inward, room, slack, back, onward, cap, owner, prism)


@compiled_lazily(error_model="numpy")
def _blocked_stretch(row: FloatArray, need: float, p: FloatArray, q: FloatArray) -> tuple[float, float]:
    """The fractions of p-q between which it is nearer than ``need`` to the obstacle; (1, 0) if nowhere."""
    d0, d1, d2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    low, high = 0.0, 1.0
    inside = -1.0
    if point_distance(row, p[0], p[1], p[2]) < need:
        inside = 0.0
    elif point_distance(row, q[0], q[1], q[2]) < need:
        inside = 1.0
    else:
        # the distance is convex along the edge: bisect on its slope until a point too near is found
        for _ in range(40):
            middle = 0.5 * (low + high)
            x, y, z = p[0] + middle * d0, p[1] + middle * d1, p[2] + middle * d2
            if point_distance(row, x, y, z) < need:
                inside = middle
                break
            g = point_gradient(row, x, y, z)
            if g[0] * d0 + g[1] * d1 + g[2] * d2 > 0.0:
                high = middle
            else:
                low = middle
        if inside < 0.0:
            return 1.0, 0.0
    enter, leave = 0.0, 1.0
    for end in range(2):
        near, far = inside, float(end)
        x, y, z = p[0] + far * d0, p[1] + far * d1, p[2] + far * d2
        if point_distance(row, x, y, z) < need:
            continue
        for _ in range(40):
            middle = 0.5 * (near + far)
            if point_distance(row, p[0] + middle * d0, p[1] + middle * d1, p[2] + middle * d2) < need:
                near = middle
            else:
                far = middle
        if end == 0:
            enter = far
        else:
            leave = far
    return enter, leave


@compiled_lazily(error_model="numpy")
def _clip(edge: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[float, float]:
    """The fractions of an edge between which it is within bounds; (1, 0) if nowhere."""
    enter, leave = 0.0, 1.0
    for axis in range(3):
        a, step = edge[FROM + axis], edge[TO + axis] - edge[FROM + axis]
        if abs(step) < LEAST_STRETCH_M:
            if a < lower[axis] or a > upper[axis]:
                return 1.0, 0.0
            continue
        first, second = (lower[axis] - a) / step, (upper[axis] - a) / step
        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    return enter, leave


@compiled_for(FREE_SPACE, FLOATS_2, types.float64, error_model="numpy", nogil=True)
def _sample(space: FreeSpace, edges: FloatArray, spacing: float) -> FloatArray:
    """Features on the free stretches of the edges and around spheres, (F, 21), a row each: see `POSITION`."""
    rows, count = np.empty((4 * edges.shape[0] + 32, NUM_FEATURE_COLUMNS)), 0
    blocked = np.empty((space.table.shape[0] + 1, 2))
    for index in range(edges.shape[0]):
        edge = edges[index]
        first, last = _clip(edge, space.lower, space.upper)
        if first <= last:
            _fill_blocked(space, edge, blocked)
            rows, count = _sample_edge(edge, first, last, blocked, spacing, space.table.shape[0], rows, count)
    return np.concatenate((rows[:count], _sample_spheres(space, 0)))


@compiled_for(FREE_SPACE, types.int64, error_model="numpy", nogil=True)
def _sample_spheres(space: FreeSpace, first: int) -> FloatArray:
    """Features around the spheres from obstacle ``first`` on, rows as in `_sample`."""
    rows, count = np.empty((NET_NODES, NUM_FEATURE_COLUMNS)), 0
    for k in range(first, space.table.shape[0]):
        if space.table[k, SHAPE] == SPHERE:
            rows, count = _sample_sphere(space, k, rows, count)
    return rows[:count]


@compiled_lazily(error_model="numpy")
def _fill_blocked(space: FreeSpace, edge: FloatArray, blocked: FloatArray) -> None:
    """Fill ``blocked`` (K + 1, 2) with the stretches of an edge that other obstacles block, in rising order; 2 after them."""
    p, q = edge[FROM : FROM + 3], edge[TO : TO + 3]
    lower, upper = np.minimum(p, q), np.maximum(p, q)
    num_blocked = 0
    for k in range(space.table.shape[0]):
        if k != int(edge[OWNER]) and may_meet(space, k, lower, upper):
            enter, leave = _blocked_stretch(space.table[k], space.needs[k], p, q)
            if enter <= leave:
                place = num_blocked
                while place > 0 and blocked[place - 1, 0] > enter:
                    blocked[place, 0], blocked[place, 1] = blocked[place - 1, 0], blocked[place - 1, 1]
                    place -= 1
                blocked[place, 0], blocked[place, 1] = enter, leave
                num_blocked += 1
    blocked[num_blocked] = 2.0


@compiled_lazily(error_model="numpy")
def _sample_edge(
    edge: FloatArray,
    first: float,
    last: float,
    blocked: FloatArray,
    spacing: float,
    num_obstacles: int,
    rows: FloatArray,
    count: int,
) -> tuple[FloatArray, int]:
    """Append features on the free stretches of an edge between two fractions of it; the rows, and how many are filled.

    A free stretch has samples at its ends and up to `MOST_SAMPLES` between them; an end that is the edge's own is left
    out where a path bends around it nowhere but along another edge, or where it lies on the bounds.
    """
    p, q = edge[FROM : FROM + 3], edge[TO : TO + 3]
    length = segment_length(p, q)
    free, stretch = first, 0
    while free < last:
        stop = min(blocked[stretch, 0], last)
        if (stop - free) * length > LEAST_STRETCH_M:
            inner = min(max(math.ceil((stop - free) * length / spacing), 1), MOST_SAMPLES)
            for sample in range(-1, inner + 1):
                share = free + (stop - free) * min(max((sample + 0.5) / inner, 0.0), 1.0)
                if sample < 0 and free == first and (first > 0.0 or edge[ENDS_BEND] == 0.0):
                    continue
                if sample == inner and stop == last and (last < 1.0 or edge[ENDS_BEND] == 0.0):
                    continue
                rows = room_for_row(rows, count)
                row = rows[count]
                for axis in range(3):
                    row[POSITION + axis] = p[axis] + share * (q[axis] - p[axis])
                    row[NORMAL + axis], row[OTHER_NORMAL + axis] = edge[FIRST + axis], edge[SECOND + axis]
                    row[ALONG + axis] = (q[axis] - p[axis]) / length
                    row[INWARD + axis] = edge[CORE + axis]
                row[ROOM], row[SLACK] = edge[ROUND], UNDERSIDE_SLACK if edge[SECOND + 2] < 0.0 else EDGE_SLACK
                row[BACK], row[ONWARD] = (free - share) * length, (stop - share) * length
                row[BESIDE] = edge[OWNER] if edge[OWNER] >= 0.0 else num_obstacles
                is_corner = edge[ENDS_BEND] > 0.0 and (share == 0.0 or share == 1.0)
                row[CAP] = np.nan if not is_corner else (1.0 if share == 1.0 else -1.0)
                count += 1
        free = max(free, blocked[stretch, 1])
        stretch += 1
    return rows, count


@compiled_lazily(error_model="numpy")
def _sample_sphere(space: FreeSpace, k: int, rows: FloatArray, count: int) -> tuple[FloatArray, int]:
    """Append a net of features around a sphere, every 45 degrees around and up; the rows, and how many are filled.

    The net is so far outside that the straight line between two of its neighbours stays clear.
    """
    away = (space.table[k, HALF_X] + space.needs[k]) / math.cos(math.pi / 8.0)
    for node in range(NET_NODES):
        tilt, turn = 0.25 * math.pi * (node // 8 - 1), 0.25 * math.pi * (node % 8)
        outward = (math.cos(tilt) * math.cos(turn), math.cos(tilt) * math.sin(turn), math.sin(tilt))
        if node >= NET_NODES - 2:
            outward = (0.0, 0.0, 1.0 if node == NET_NODES - 2 else -1.0)
        rows = room_for_row(rows, count)
        row = rows[count]
        for axis in range(3):
            row[POSITION + axis] = space.table[k, X + axis] + away * outward[axis]
            row[NORMAL + axis] = row[OTHER_NORMAL + axis] = outward[axis]
            row[ALONG + axis], row[INWARD + axis] = 0.0, -away * outward[axis]
        row[ROOM], row[SLACK] = space.table[k, HALF_X] + space.needs[k], SPHERE_SLACK
        row[BACK] = row[ONWARD] = 0.0
        row[CAP], row[BESIDE] = np.nan, k
        if inside(space, row) and _free(space, row):
            count += 1
    return rows, count


@compiled_lazily(error_model="numpy")
def _free(space: FreeSpace, point: FloatArray) -> bool:
    for k in range(space.table.shape[0]):
        if point_distance(space.table[k], point[0], point[1], point[2]) < space.needs[k]:
            return False
    return True
