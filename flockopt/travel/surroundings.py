"""Compiled: free space with its obstacles listed by the cell of ground they stand over, so that a look costs what is near it.

A segment is followed from cell to cell (Amanatides and Woo 1987), and only what stands over those cells is looked at.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, INTEGERS_2, compiled_for, compiled_lazily, record_of
from flockopt.geometry.distances import (
    BOX,
    COS_YAW,
    HALF_X,
    HALF_Y,
    HALF_Z,
    OBSTACLE_COLUMNS,
    SHAPE,
    SIN_YAW,
    X,
    Y,
    Z,
)  # fmt: skip
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.geometry.kernels import point_distance
from flockopt.records.arrays import FloatArray
from flockopt.travel.blocking import too_near

__all__ = [
    "EASED", "SURROUNDINGS", "Eased", "Surroundings", "blocked_between", "ease", "eased_places", "is_within", "obstructed",
    "obstruction", "own_needs", "restore", "surroundings", "uneased",
]  # fmt: skip

#: Up to so many obstacles are all looked at; beyond, there is a cell for each `OBSTACLES_A_CELL` of them.
FEW_OBSTACLES, OBSTACLES_A_CELL = 8, 1.0
#: How far around its box an obstacle is listed, metres: more than rounding can move a segment beside a cell's corner.
RIM_M = 1e-6

#: Columns of `Surroundings.rows` after those of an obstacle: what is to be kept from it, and the radius of the circle around
#: its footprint grown by that.
NEED, REACH = len(OBSTACLE_COLUMNS), len(OBSTACLE_COLUMNS) + 1


class Surroundings(NamedTuple):
    """A free space in few arrays: its K obstacles, and which of them stand over each cell of a grid over the ground."""

    rows: FloatArray  # (K, 11) obstacle rows, `NEED` and `REACH`
    bounds: FloatArray  # (2, 3) m; the grid begins at the lower corner
    side: float  # m, of a cell
    across: int  # cells along x
    deep: int  # cells along y
    begin: NDArray[np.int64]  # (cells + 1,) where a cell's obstacles begin
    standing: NDArray[np.int64]  # obstacles, cell by cell


class Eased(NamedTuple):
    """What P places need less of: obstacles so near to them that their ways may come nearer, too."""

    begin: NDArray[np.int64]  # (P + 1,) where a place's obstacles begin
    obstacle: NDArray[np.int64]
    need: FloatArray  # m


#: The same as compiled code knows them.
SURROUNDINGS = record_of(Surroundings, FLOATS_2, FLOATS_2, types.float64, types.int64, types.int64, INTEGERS_1, INTEGERS_1)
EASED = record_of(Eased, INTEGERS_1, INTEGERS_1, FLOATS_1)


def surroundings(space: FreeSpace) -> Surroundings:
    """The surroundings of a free space."""
    size = (space.upper - space.lower)[:2]
    side, across, deep = float(size.max()), 1, 1
    if len(space.table) > FEW_OBSTACLES:
        side = max(math.sqrt(float(size.prod()) * OBSTACLES_A_CELL / len(space.table)), side / len(space.table), 1e-3)
        across, deep = (max(math.ceil(extent / side), 1) for extent in size.tolist())
    rows = np.column_stack([space.table, space.needs, space.reach])
    bounds = np.array([space.lower, space.upper])
    return Surroundings(rows, bounds, side, across, deep, *_listed(space, side, across, deep))


def uneased(num_places: int) -> Eased:
    """Places that need no less of anything."""
    return Eased(np.zeros(num_places + 1, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0))


@compiled_for(FREE_SPACE, types.float64, types.int64, types.int64, error_model="numpy")
def _listed(space: FreeSpace, side: float, across: int, deep: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`Surroundings.begin` and `Surroundings.standing`."""
    begin = np.zeros(across * deep + 2, dtype=np.int64)  # one ahead, so that filling leaves each where its own begins
    standing = np.empty(0, dtype=np.int64)
    for turn in range(2):  # count, then fill
        for k in range(space.table.shape[0]):
            reach = space.needs[k] + RIM_M
            first_x = _cell(space.boxes[k, 0, 0] - reach - space.lower[0], side, across)
            last_x = _cell(space.boxes[k, 1, 0] + reach - space.lower[0], side, across)
            first_y = _cell(space.boxes[k, 0, 1] - reach - space.lower[1], side, deep)
            last_y = _cell(space.boxes[k, 1, 1] + reach - space.lower[1], side, deep)
            for i in range(first_x, last_x + 1):
                for j in range(first_y, last_y + 1):
                    cell = i * deep + j
                    if turn == 0:
                        begin[cell + 2] += 1
                    else:
                        standing[begin[cell + 1]] = k
                        begin[cell + 1] += 1
        if turn == 0:
            for cell in range(2, begin.shape[0]):
                begin[cell] += begin[cell - 1]
            standing = np.empty(begin[-1], dtype=np.int64)
    return begin[:-1].copy(), standing


@compiled_lazily(error_model="numpy")
def _cell(away: float, side: float, count: int) -> int:
    """The row of cells that a place so far from the corner is in; the first or last where it is outside."""
    return int(min(max(math.floor(away / side), 0), count - 1))


@compiled_lazily(error_model="numpy")
def obstruction(
    around: Surroundings, px: float, py: float, pz: float, qx: float, qy: float, qz: float, guess: int, one: int, other: int
) -> int:
    """An obstacle that the segment p-q comes too near to, or -1.

    Args:
        around: What there is.
        px: m, of one end.
        py: m.
        pz: m.
        qx: m, of the other end.
        qy: m.
        qz: m.
        guess: Which obstacle to try first, or -1.
        one: One that is known to be clear of the segment, or -1.
        other: One more, or -1.
    """
    # in one piece, and inlined: a path search asks this more often than anything else
    rows, begin, standing, side = around.rows, around.begin, around.standing, around.side
    if guess >= 0 and too_near(rows, guess, rows[guess, NEED], px, py, pz, qx, qy, qz):
        return guess
    dx, dy = qx - px, qy - py
    low, high = min(pz, qz), max(pz, qz)
    squared = dx * dx + dy * dy
    length = math.sqrt(squared)
    i = j = last_i = last_j = 0
    at_x = at_y = through_x = through_y = np.inf
    if around.across * around.deep > 1:
        x, y = px - around.bounds[0, 0], py - around.bounds[0, 1]
        i, j = _cell(x, side, around.across), _cell(y, side, around.deep)
        last_i, last_j = _cell(x + dx, side, around.across), _cell(y + dy, side, around.deep)
        # when it leaves its row of cells, as a fraction of the segment, and how long it takes through each after that
        if last_i != i:
            at_x, through_x = ((i + (1 if dx > 0.0 else 0)) * side - x) / dx, side / abs(dx)
        if last_j != j:
            at_y, through_y = ((j + (1 if dy > 0.0 else 0)) * side - y) / dy, side / abs(dy)
    while True:
        cell = i * around.deep + j
        for place in range(begin[cell], begin[cell + 1]):
            k = standing[place]
            cx, cy = rows[k, X] - px, rows[k, Y] - py
            across, beside = rows[k, REACH] * length, abs(dx * cy - dy * cx)
            if beside > across:
                continue
            if rows[k, SHAPE] == BOX and beside > (
                rows[k, HALF_X] * abs(rows[k, SIN_YAW] * dx - rows[k, COS_YAW] * dy)
                + rows[k, HALF_Y] * abs(rows[k, COS_YAW] * dx + rows[k, SIN_YAW] * dy)
                + rows[k, NEED] * length
            ):
                continue
            tall = rows[k, HALF_Z] + rows[k, NEED]
            if low > rows[k, Z] + tall or high < rows[k, Z] - tall:
                continue
            ahead = dx * cx + dy * cy
            if ahead < -across or ahead > squared + across:
                continue
            if k != guess and k != one and k != other and too_near(rows, k, rows[k, NEED], px, py, pz, qx, qy, qz):
                return k
        if i == last_i and j == last_j:
            return -1
        if j == last_j or (i != last_i and at_x < at_y):
            i, at_x = (i + 1 if last_i > i else i - 1), at_x + through_x
        else:
            j, at_y = (j + 1 if last_j > j else j - 1), at_y + through_y


@compiled_lazily(error_model="numpy")
def obstructed(around: Surroundings, p: FloatArray, q: FloatArray) -> bool:
    """Whether the segment between two points (3,) m comes too near to some obstacle."""
    return obstruction(around, p[0], p[1], p[2], q[0], q[1], q[2], -1, -1, -1) >= 0


@compiled_lazily(error_model="numpy")
def is_within(around: Surroundings, point: FloatArray) -> bool:
    """Whether a point (3,) m is within the bounds."""
    for axis in range(3):  # noqa: SIM110 - numba has no generators
        if point[axis] < around.bounds[0, axis] or point[axis] > around.bounds[1, axis]:
            return False
    return True


@compiled_for(SURROUNDINGS, FLOATS_2, types.float64, types.float64, error_model="numpy", nogil=True)
def eased_places(
    around: Surroundings, points: FloatArray, need: float, margin: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """The fields of `Eased` for points (P, 3): of what is kept beyond ``need``, half the room that a place leaves is kept."""
    begin = np.zeros(points.shape[0] + 1, dtype=np.int64)
    obstacle, eased, used = np.empty(16, dtype=np.int64), np.empty(16), 0
    for p in range(points.shape[0]):
        i = _cell(points[p, 0] - around.bounds[0, 0], around.side, around.across)
        j = _cell(points[p, 1] - around.bounds[0, 1], around.side, around.deep)
        cell = i * around.deep + j
        for place in range(around.begin[cell], around.begin[cell + 1]):
            k = around.standing[place]
            slack = point_distance(around.rows[k], points[p, 0], points[p, 1], points[p, 2]) - need
            if slack >= margin:
                continue
            if used == obstacle.shape[0]:
                wider, wider_need = np.empty(2 * used, dtype=np.int64), np.empty(2 * used)
                wider[:used], wider_need[:used] = obstacle, eased
                obstacle, eased = wider, wider_need
            obstacle[used], eased[used] = k, need + (0.5 * slack if slack > 0.0 else slack)
            used += 1
        begin[p + 1] = used
    return begin, obstacle[:used].copy(), eased[:used].copy()


@compiled_lazily(error_model="numpy")
def own_needs(around: Surroundings) -> Surroundings:
    """The same surroundings with needs of their own, for `ease`."""
    return Surroundings(
        around.rows.copy(), around.bounds, around.side, around.across, around.deep, around.begin, around.standing
    )


@compiled_lazily(error_model="numpy")
def ease(own: Surroundings, eased: Eased, place: int) -> None:
    """Let ways come as near to obstacles as a place needs it."""
    for entry in range(eased.begin[place], eased.begin[place + 1]):
        k = eased.obstacle[entry]
        own.rows[k, NEED] = min(own.rows[k, NEED], eased.need[entry])


@compiled_lazily(error_model="numpy")
def restore(own: Surroundings, around: Surroundings, eased: Eased, place: int) -> None:
    """Take back what `ease` did."""
    for entry in range(eased.begin[place], eased.begin[place + 1]):
        k = eased.obstacle[entry]
        own.rows[k, NEED] = around.rows[k, NEED]


@compiled_for(SURROUNDINGS, EASED, FLOATS_2, INTEGERS_2, error_model="numpy", nogil=True)
def blocked_between(around: Surroundings, eased: Eased, points: FloatArray, pairs: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether the straight flights between pairs (L, 2) of points (P, 3) come too near to some obstacle, (L,)."""
    own = own_needs(around)
    blocked = np.zeros(pairs.shape[0], dtype=np.bool_)
    guess = -1
    for index in range(pairs.shape[0]):
        i, j = pairs[index, 0], pairs[index, 1]
        ease(own, eased, i)
        ease(own, eased, j)
        guess = obstruction(
            own, points[i, 0], points[i, 1], points[i, 2], points[j, 0], points[j, 1], points[j, 2], guess, -1, -1
        )  # fmt: skip
        blocked[index] = guess >= 0
        restore(own, around, eased, i)
        restore(own, around, eased, j)
    return blocked
