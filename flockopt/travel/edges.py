"""Compiled: the lines that shortest paths bend around, edges of obstacles grown by what a drone needs.

Every box and cylinder is enclosed in a prism whose footprint has `NUM_SIDES` sides tangent to the grown
footprint. Where two obstacles leave so narrow a gap that the corners of their prisms close it, a line through
the middle of the gap is added.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from flockopt.geometry.distances import BOX, SPHERE
from flockopt.geometry.kernels import point_distance, point_gradient
from flockopt.records.arrays import FloatArray
from flockopt.travel.blocking import Space

__all__ = ["NUM_SIDES", "feature_edges", "room_for_row"]

#: Sides of the polygon around a grown footprint: a multiple of four, so that a box keeps its faces.
NUM_SIDES = 8
#: How far corners of a prism, and points of a sphere's net, stand out, as a share of the grown radius.
CORNER_EXCESS, NET_EXCESS = 0.083, 0.25
#: How far before and behind a narrow gap a path may bend, as a share of the grown radius: half a side of the polygon.
BACK_SHARE = 0.42
#: Most projections in the search for the nearest points of two obstacles, and the step that ends it, metres.
MOST_PROJECTIONS, LEAST_STEP_M = 60, 1e-7
#: Half the height of the line through a gap beside a sphere, metres: one sample.
GAP_POINT_M = 1e-4


def feature_edges(space: Space) -> FloatArray:
    """The edges, (E, 14): both ends, both outward normals, owner (-1 if none), and whether the ends are features."""
    return np.concatenate([_prism_edges(space.table, space.needs), _gap_edges(space.table, space.needs, space.reach)])


@njit(cache=True, error_model="numpy")
def room_for_row(rows: FloatArray, count: int) -> FloatArray:
    """Room for one more row."""
    if count < rows.shape[0]:
        return rows
    wider = np.empty((2 * rows.shape[0], rows.shape[1]))
    for row in range(count):
        for column in range(rows.shape[1]):
            wider[row, column] = rows[row, column]
    return wider


@njit(cache=True, error_model="numpy")
def _footprint(row: FloatArray, need: float, normals: FloatArray, corners: FloatArray) -> None:
    """Fill the outward normals (S, 2) and the corners (S, 2) of the polygon; corner i joins sides i and i + 1."""
    sides = normals.shape[0]
    support = np.empty(sides)
    for side in range(sides):
        angle = 2.0 * math.pi * side / sides
        u, v = math.cos(angle), math.sin(angle)
        reach = row[4] * abs(u) + row[5] * abs(v) if row[0] == BOX else row[4]
        support[side] = reach + need
        normals[side, 0], normals[side, 1] = row[7] * u - row[8] * v, row[8] * u + row[7] * v
    for side in range(sides):
        after = (side + 1) % sides
        a, b, c, d = normals[side, 0], normals[side, 1], normals[after, 0], normals[after, 1]
        cross = a * d - b * c
        corners[side, 0] = row[1] + (support[side] * d - support[after] * b) / cross
        corners[side, 1] = row[2] + (support[after] * a - support[side] * c) / cross


@njit(cache=True, error_model="numpy")
def _prism_edges(table: FloatArray, needs: FloatArray) -> FloatArray:
    """Edges of the prisms that enclose the grown boxes and cylinders, (E, 14)."""
    edges = np.empty((table.shape[0] * 3 * NUM_SIDES, 14))
    normals, corners = np.empty((NUM_SIDES, 2)), np.empty((NUM_SIDES, 2))
    count = 0
    for k in range(table.shape[0]):
        row = table[k]
        if row[0] == SPHERE:
            continue
        _footprint(row, needs[k], normals, corners)
        bottom, top = row[3] - row[6] - needs[k], row[3] + row[6] + needs[k]
        for side in range(NUM_SIDES):
            after = (side + 1) % NUM_SIDES
            edge = edges[count]
            edge[0:2], edge[2] = corners[side], bottom
            edge[3:5], edge[5] = corners[side], top
            edge[6:8], edge[8] = normals[side], 0.0
            edge[9:11], edge[11] = normals[after], 0.0
            edge[12], edge[13] = k, 1.0
            count += 1
            # the short sides that round a box's corners are covered by the ends of the vertical edges
            if row[0] == BOX and side % (NUM_SIDES // 4) != 0:
                continue
            before = (side - 1) % NUM_SIDES
            for level, up in ((bottom, -1.0), (top, 1.0)):
                edge = edges[count]
                edge[0:2], edge[2] = corners[before], level
                edge[3:5], edge[5] = corners[side], level
                edge[6:8], edge[8] = normals[side], 0.0
                edge[9:11], edge[11] = 0.0, up
                edge[12], edge[13] = k, 0.0
                count += 1
    return edges[:count]


@njit(cache=True, error_model="numpy")
def _gap_edges(table: FloatArray, needs: FloatArray, reach: FloatArray) -> FloatArray:
    """Upright lines through gaps narrower than the corners around them stand out, (E, 14); any bend is good there."""
    edges, count = np.zeros((8, 14)), 0
    middle = np.empty(3)
    for first in range(table.shape[0]):
        for second in range(first + 1, table.shape[0]):
            narrow = max(_excess(table[first], needs[first]), _excess(table[second], needs[second]))
            apart = math.hypot(table[first, 1] - table[second, 1], table[first, 2] - table[second, 2])
            low = max(table[first, 3] - table[first, 6] - needs[first], table[second, 3] - table[second, 6] - needs[second])
            high = min(table[first, 3] + table[first, 6] + needs[first], table[second, 3] + table[second, 6] + needs[second])
            if apart > reach[first] + reach[second] + narrow or low >= high:
                continue
            gap = _gap(table, needs, first, second, 0.5 * (low + high), middle)
            if gap < 0.0 or gap > narrow:
                continue
            if table[first, 0] == SPHERE or table[second, 0] == SPHERE:
                low, high = middle[2] - GAP_POINT_M, middle[2] + GAP_POINT_M
            # before and behind the gap as far as the next corners: what those see is seen from there
            back = BACK_SHARE / CORNER_EXCESS * narrow
            across_x, across_y = table[first, 1] - middle[0], table[first, 2] - middle[1]
            across = max(math.hypot(across_x, across_y), 1e-9)
            for side in range(-1, 2):
                edges = room_for_row(edges, count)
                for column in range(14):
                    edges[count, column] = 0.0
                for end in range(2):
                    edges[count, 3 * end] = middle[0] - side * back * across_y / across
                    edges[count, 3 * end + 1] = middle[1] + side * back * across_x / across
                    edges[count, 3 * end + 2] = low if end == 0 else high
                edges[count, 12] = -1.0
                count += 1
    return edges[:count]


@njit(cache=True, error_model="numpy")
def _excess(row: FloatArray, need: float) -> float:
    """How far a feature may stand out from the grown obstacle, metres."""
    if row[0] == BOX:
        return CORNER_EXCESS * need
    return (NET_EXCESS if row[0] == SPHERE else CORNER_EXCESS) * (row[4] + need)


@njit(cache=True, error_model="numpy")
def _gap(table: FloatArray, needs: FloatArray, first: int, second: int, height: float, middle: FloatArray) -> float:
    """Width of the gap that two obstacles leave a drone's centre, by projecting back and forth between them.

    Fills the point ``middle`` of the gap; returns -inf where the obstacles touch.
    """
    here, there = np.empty(3), np.empty(3)
    there[0], there[1], there[2] = table[first, 1], table[first, 2], height
    distance = np.inf
    for turn in range(MOST_PROJECTIONS):
        row = table[second] if turn % 2 == 0 else table[first]
        away = point_distance(row, there[0], there[1], there[2])
        if away <= 0.0:
            return -np.inf
        g = point_gradient(row, there[0], there[1], there[2])
        for axis in range(3):
            here[axis] = there[axis]
            there[axis] -= away * g[axis]
        if turn > 0 and turn % 2 == 0 and distance - away <= LEAST_STEP_M:
            break
        distance = away
    # the last projection went from `here`, on the first obstacle, to `there`, on the second, or the other way
    gap = away - needs[first] - needs[second]
    share = (needs[first] if turn % 2 == 0 else needs[second]) + 0.5 * gap
    for axis in range(3):
        middle[axis] = here[axis] + share / away * (there[axis] - here[axis])
    return gap
