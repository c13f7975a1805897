"""Where shortest paths bend: points on the edges of obstacles grown by what a drone needs.

A shortest path among convex obstacles is straight except where it wraps an edge. The edges of `flockopt.travel.edges` are
sampled where they are free of every other obstacle, and a sphere gets a net of single points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from flockopt.geometry.distances import SPHERE
from flockopt.geometry.kernels import point_distance, point_gradient
from flockopt.records.arrays import FloatArray
from flockopt.travel.blocking import Space
from flockopt.travel.edges import feature_edges, room_for_row

__all__ = ["Features", "make_features", "unrestricted"]

#: Most samples on the inner part of one free stretch of an edge.
MOST_SAMPLES = 3
#: A stretch of edge gets one more sample for each of these fractions of the space's longest side.
SPACING_SHARE = 1.0 / 12.0
#: Shorter free stretches are too narrow to be worth a sample, metres.
LEAST_STRETCH_M = 1e-6
#: How far, as the product of two sines, an edge may be from tangent at a feature and still be of use.
EDGE_SLACK, SPHERE_SLACK = 1e-6, 0.25
#: The same for how far a bend may turn away from the obstacle: a sampled bend is a little off the best one.
BEND_SLACK = 0.3


class Features(NamedTuple):
    """Points where a path may bend, with the two faces that meet there."""

    position: FloatArray  # (F, 3) m
    first: FloatArray  # (F, 3) outward normal of one face
    second: FloatArray  # (F, 3) outward normal of the other face
    along: FloatArray  # (F, 3) unit direction of the edge; zero on a sphere
    slack: FloatArray  # (F,) see EDGE_SLACK
    bend: float  # how far, as a sine, a bend may turn away from the obstacle it is around


def make_features(space: Space) -> Features:
    """All features of a space, in the order of its obstacles."""
    spacing = SPACING_SHARE * float((space.upper - space.lower).max())
    rows = _sample(space, feature_edges(space), spacing)
    parts = [np.ascontiguousarray(rows[:, 3 * part : 3 * part + 3]) for part in range(4)]
    return Features(parts[0], parts[1], parts[2], parts[3], np.ascontiguousarray(rows[:, 12]), BEND_SLACK)


def unrestricted(features: Features) -> Features:
    """The same features for any line through them and any bend at them."""
    return features._replace(slack=np.full(len(features.slack), np.inf), bend=np.inf)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _near(row: FloatArray, need: float, reach: float, p: FloatArray, q: FloatArray) -> bool:
    """Whether the bounding boxes of the grown obstacle's hull and of p-q meet."""
    for axis in range(3):
        room = row[6] + need if axis == 2 and row[0] != SPHERE else reach
        if max(p[axis], q[axis]) < row[1 + axis] - room or min(p[axis], q[axis]) > row[1 + axis] + room:
            return False
    return True


@njit(cache=True, error_model="numpy")
def _clip(edge: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[float, float]:
    """The fractions of an edge between which it is within bounds; (1, 0) if nowhere."""
    enter, leave = 0.0, 1.0
    for axis in range(3):
        a, step = edge[axis], edge[3 + axis] - edge[axis]
        if abs(step) < LEAST_STRETCH_M:
            if a < lower[axis] or a > upper[axis]:
                return 1.0, 0.0
            continue
        first, second = (lower[axis] - a) / step, (upper[axis] - a) / step
        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    return enter, leave


@njit(cache=True, error_model="numpy")
def _sphere_net(row: FloatArray, need: float, net: FloatArray) -> int:
    """Fill ``net`` (26, 3) with outward directions; return the distance-scaled count of points."""
    count = 0
    for tilt in (-0.25 * math.pi, 0.0, 0.25 * math.pi):
        for step in range(8):
            turn = 0.25 * math.pi * step
            net[count, 0] = math.cos(tilt) * math.cos(turn)
            net[count, 1] = math.cos(tilt) * math.sin(turn)
            net[count, 2] = math.sin(tilt)
            count += 1
    net[count] = 0.0
    net[count, 2] = 1.0
    net[count + 1] = 0.0
    net[count + 1, 2] = -1.0
    return count + 2


@njit(cache=True, error_model="numpy")
def _sample(space: Space, edges: FloatArray, spacing: float) -> FloatArray:
    """Features on the free stretches of the edges and around spheres, (F, 13): see `Features` for the columns."""
    table, needs, reach, lower, upper = space
    num_obstacles = table.shape[0]
    rows = np.empty((4 * edges.shape[0] + 32, 13))
    count = 0
    blocked = np.empty((num_obstacles + 1, 2))
    for index in range(edges.shape[0]):
        edge = edges[index]
        first, last = _clip(edge, lower, upper)
        if first > last:
            continue
        p, q = edge[0:3], edge[3:6]
        length = math.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2)
        num_blocked = 0
        for k in range(num_obstacles):
            if k != int(edge[12]) and _near(table[k], needs[k], reach[k], p, q):
                enter, leave = _blocked_stretch(table[k], needs[k], p, q)
                if enter <= leave:
                    place = num_blocked
                    while place > 0 and blocked[place - 1, 0] > enter:
                        blocked[place] = blocked[place - 1]
                        place -= 1
                    blocked[place, 0], blocked[place, 1] = enter, leave
                    num_blocked += 1
        blocked[num_blocked] = 2.0
        free = first
        for stretch in range(num_blocked + 1):
            stop = min(blocked[stretch, 0], last)
            if (stop - free) * length > LEAST_STRETCH_M:
                inner = min(max(math.ceil((stop - free) * length / spacing), 1), MOST_SAMPLES)
                for sample in range(-1, inner + 1):
                    share = free + (stop - free) * min(max((sample + 0.5) / inner, 0.0), 1.0)
                    if sample < 0 and free == first and (first > 0.0 or edge[13] == 0.0):
                        continue
                    if sample == inner and stop == last and (last < 1.0 or edge[13] == 0.0):
                        continue
                    rows = room_for_row(rows, count)
                    for axis in range(3):
                        rows[count, axis] = p[axis] + share * (q[axis] - p[axis])
                        rows[count, 9 + axis] = (q[axis] - p[axis]) / length
                    rows[count, 3:9] = edge[6:12]
                    rows[count, 12] = EDGE_SLACK
                    count += 1
            free = max(free, blocked[stretch, 1])
            if free >= last:
                break
    net = np.empty((26, 3))
    for k in range(num_obstacles):
        if table[k, 0] != SPHERE:
            continue
        away = (table[k, 4] + needs[k]) / math.cos(math.pi / 8.0)
        for sample in range(_sphere_net(table[k], needs[k], net)):
            rows = room_for_row(rows, count)
            rows[count] = 0.0
            usable = True
            for axis in range(3):
                rows[count, axis] = table[k, 1 + axis] + away * net[sample, axis]
                rows[count, 3 + axis] = rows[count, 6 + axis] = net[sample, axis]
                usable = usable and lower[axis] <= rows[count, axis] <= upper[axis]
            rows[count, 12] = SPHERE_SLACK
            if usable and _free(space, rows[count]):
                count += 1
    return rows[:count]


@njit(cache=True, error_model="numpy")
def _free(space: Space, point: FloatArray) -> bool:
    for k in range(space.table.shape[0]):
        if point_distance(space.table[k], point[0], point[1], point[2]) < space.needs[k]:
            return False
    return True
