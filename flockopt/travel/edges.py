"""Compiled: the lines that shortest paths bend around, edges of obstacles grown by what a drone needs.

Every box and cylinder is enclosed in a prism whose footprint has `NUM_SIDES` sides tangent to the grown
footprint. Where two obstacles leave so narrow a gap that the corners of their prisms close it, a line through
the middle of the gap is added.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_2, compiled_for, compiled_lazily, writable
from flockopt.geometry.distances import BOX, COS_YAW, HALF_X, HALF_Y, HALF_Z, SHAPE, SIN_YAW, SPHERE, X, Y, Z
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.geometry.kernels import point_distance, point_gradient
from flockopt.records.arrays import FloatArray

__all__ = ["CORE", "ENDS_BEND", "FIRST", "FROM", "NUM_SIDES", "OWNER", "ROUND", "SECOND", "TO", "feature_edges", "room_for_row"]

#: Where an edge's columns begin: both ends, (3,) m each, the outward normals of the two faces that meet there, (3,) each,
#: the obstacle it belongs to (-1 if none), whether its ends are places to bend at too, and the round core that ways wind
#: around there: a line beside the edge, (3,) m away, and how far from it they keep, metres (0 where there is none).
FROM, TO, FIRST, SECOND, OWNER, ENDS_BEND, CORE, ROUND = 0, 3, 6, 9, 12, 13, 14, 17
NUM_EDGE_COLUMNS = 18

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


def feature_edges(space: FreeSpace) -> FloatArray:
    """The edges, (E, 18), a row each: see `FROM` and the columns after it."""
    return np.concatenate([_prism_edges(space), _gap_edges(space)])


@compiled_for(writable(FLOATS_2), types.int64, error_model="numpy")
def room_for_row(rows: FloatArray, count: int) -> FloatArray:
    """Room for one more row."""
    if count < rows.shape[0]:
        return rows
    wider = np.empty((2 * rows.shape[0], rows.shape[1]))
    for row in range(count):
        for column in range(rows.shape[1]):
            wider[row, column] = rows[row, column]
    return wider


@compiled_lazily(error_model="numpy")
def _footprint(row: FloatArray, need: float, normals: FloatArray, corners: FloatArray) -> None:
    """Fill the outward normals (S, 2) and the corners (S, 2) of the polygon; corner i joins sides i and i + 1."""
    sides = normals.shape[0]
    support = np.empty(sides)
    for side in range(sides):
        angle = 2.0 * math.pi * side / sides
        u, v = math.cos(angle), math.sin(angle)
        reach = row[HALF_X] * abs(u) + row[HALF_Y] * abs(v) if row[SHAPE] == BOX else row[HALF_X]
        support[side] = reach + need
        normals[side, 0], normals[side, 1] = row[COS_YAW] * u - row[SIN_YAW] * v, row[SIN_YAW] * u + row[COS_YAW] * v
    for side in range(sides):
        after = (side + 1) % sides
        a, b, c, d = normals[side, 0], normals[side, 1], normals[after, 0], normals[after, 1]
        cross = a * d - b * c
        corners[side, 0] = row[X] + (support[side] * d - support[after] * b) / cross
        corners[side, 1] = row[Y] + (support[after] * a - support[side] * c) / cross


@compiled_for(FREE_SPACE, error_model="numpy", nogil=True)
def _prism_edges(space: FreeSpace) -> FloatArray:
    """Edges of the prisms that enclose the grown boxes and cylinders, (E, 18)."""
    table, needs = space.table, space.needs
    edges = np.zeros((table.shape[0] * 3 * NUM_SIDES, NUM_EDGE_COLUMNS))
    normals, corners = np.empty((NUM_SIDES, 2)), np.empty((NUM_SIDES, 2))
    count = 0
    for k in range(table.shape[0]):
        row = table[k]
        if row[SHAPE] == SPHERE:
            continue
        _footprint(row, needs[k], normals, corners)
        bottom, top = row[Z] - row[HALF_Z] - needs[k], row[Z] + row[HALF_Z] + needs[k]
        for side in range(NUM_SIDES):
            after = (side + 1) % NUM_SIDES
            edge = edges[count]
            for axis in range(2):
                edge[FROM + axis] = edge[TO + axis] = corners[side, axis]
                edge[FIRST + axis], edge[SECOND + axis] = normals[side, axis], normals[after, axis]
            edge[FROM + 2], edge[TO + 2] = bottom, top
            edge[OWNER], edge[ENDS_BEND] = k, 1.0
            _fill_upright_core(edge, row, needs[k], side)
            count += 1
            # the short sides that round a box's corners are covered by the ends of the vertical edges
            if row[SHAPE] == BOX and side % (NUM_SIDES // 4) != 0:
                continue
            before = (side - 1) % NUM_SIDES
            for level, up in ((bottom, -1.0), (top, 1.0)):
                edge = edges[count]
                for axis in range(2):
                    edge[FROM + axis], edge[TO + axis] = corners[before, axis], corners[side, axis]
                    edge[FIRST + axis] = normals[side, axis]
                edge[FROM + 2] = edge[TO + 2] = level
                edge[SECOND + 2], edge[OWNER], edge[ROUND] = up, k, needs[k]
                for axis in range(3):
                    edge[CORE + axis] = -needs[k] * (edge[FIRST + axis] + edge[SECOND + axis])
                count += 1
    return edges[:count]


@compiled_lazily(error_model="numpy")
def _fill_upright_core(edge: FloatArray, row: FloatArray, need: float, side: int) -> None:
    """The core of an upright edge after a side of the prism: a cylinder's axis, or the corner of a box nearest to it."""
    x, y = row[X], row[Y]
    edge[ROUND] = need
    if row[SHAPE] == BOX:
        u = row[HALF_X] if side < 2 or side > 5 else -row[HALF_X]
        v = row[HALF_Y] if side < 4 else -row[HALF_Y]
        x, y = x + row[COS_YAW] * u - row[SIN_YAW] * v, y + row[SIN_YAW] * u + row[COS_YAW] * v
    else:
        edge[ROUND] += row[HALF_X]
    edge[CORE], edge[CORE + 1] = x - edge[FROM], y - edge[FROM + 1]


@compiled_for(FREE_SPACE, error_model="numpy", nogil=True)
def _gap_edges(space: FreeSpace) -> FloatArray:
    """Upright lines through gaps narrower than the corners around them stand out, (E, 18); any bend is good there."""
    table, needs, reach = space.table, space.needs, space.reach
    edges, count = np.zeros((8, NUM_EDGE_COLUMNS)), 0
    middle = np.empty(3)
    for first in range(table.shape[0]):
        for second in range(first + 1, table.shape[0]):
            narrow = max(_excess(table[first], needs[first]), _excess(table[second], needs[second]))
            apart = math.hypot(table[first, X] - table[second, X], table[first, Y] - table[second, Y])
            low = max(
                table[first, Z] - table[first, HALF_Z] - needs[first], table[second, Z] - table[second, HALF_Z] - needs[second]
            )
            high = min(
                table[first, Z] + table[first, HALF_Z] + needs[first], table[second, Z] + table[second, HALF_Z] + needs[second]
            )
            if apart > reach[first] + reach[second] + narrow or low >= high:
                continue
            gap = _gap(space, first, second, 0.5 * (low + high), middle)
            if gap < 0.0 or gap > narrow:
                continue
            if table[first, SHAPE] == SPHERE or table[second, SHAPE] == SPHERE:
                low, high = middle[2] - GAP_POINT_M, middle[2] + GAP_POINT_M
            # before and behind the gap as far as the next corners: what those see is seen from there
            back = BACK_SHARE / CORNER_EXCESS * narrow
            across_x, across_y = table[first, X] - middle[0], table[first, Y] - middle[1]
            across = max(math.hypot(across_x, across_y), 1e-9)
            for side in range(-1, 2):
                edges = room_for_row(edges, count)
                edge = edges[count]
                edge[:] = 0.0
                edge[FROM] = edge[TO] = middle[0] - side * back * across_y / across
                edge[FROM + 1] = edge[TO + 1] = middle[1] + side * back * across_x / across
                edge[FROM + 2], edge[TO + 2], edge[OWNER] = low, high, -1.0
                count += 1
    return edges[:count]


@compiled_lazily(error_model="numpy")
def _excess(row: FloatArray, need: float) -> float:
    """How far a feature may stand out from the grown obstacle, metres."""
    if row[SHAPE] == BOX:
        return CORNER_EXCESS * need
    return (NET_EXCESS if row[SHAPE] == SPHERE else CORNER_EXCESS) * (row[HALF_X] + need)


@compiled_lazily(error_model="numpy")
def _gap(space: FreeSpace, first: int, second: int, height: float, middle: FloatArray) -> float:
    """Width of the gap that two obstacles leave a drone's centre, by projecting back and forth between them.

    Fills the point ``middle`` of the gap; returns -inf where the obstacles touch.
    """
    table, needs = space.table, space.needs
    here, there = np.empty(3), np.empty(3)
    there[0], there[1], there[2] = table[first, X], table[first, Y], height
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
