"""Compiled graph search on a voxel grid: Dijkstra's costs from one voxel to many, and A* between two.

The grid has a rim of blocked voxels, so that steps need no check of bounds. Costs are in voxel sides: 1, sqrt 2 or
sqrt 3 a step. No step is shorter than 1, so buckets of width 1 hold final costs and need no order within
(Denardo and Fox 1979).
"""

from __future__ import annotations

import heapq
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.geometry.distances import X, Y
from flockopt.geometry.free_space import FreeSpace
from flockopt.geometry.kernels import point_distance
from flockopt.records.arrays import FloatArray, IntArray
from flockopt.travel.blocking import blocker

__all__ = ["Grid", "astar", "center_of", "dijkstra", "linked_voxel", "make_grid", "moves_of"]

#: Costs closer than this are equal, in voxel sides.
SAME_COST = 1e-9

#: Buckets that hold all voxels within reach of the one at hand: no step is as long as 2.
NUM_BUCKETS = 3

#: A place is linked to a voxel at most so many voxels away along each axis.
LINK_REACH = 2


class Grid(NamedTuple):
    """Free voxels and the free steps between them; V voxels, the rim included, and D directions."""

    lower: FloatArray  # (3,) m, centre of voxel (0, 0, 0), which is on the rim
    side: float  # m
    shape: IntArray  # (3,) voxels along each axis
    moves: IntArray  # (D, 3) steps
    costs: FloatArray  # (D,) voxel sides
    strides: IntArray  # (D,) what a step adds to a voxel's index
    is_free: NDArray[np.bool_]  # (V,)
    steps: NDArray[np.uint32]  # (V,) bit d: step d is free


def moves_of(connectivity: int) -> IntArray:
    """(D, 3) steps to the 6 or 26 neighbours; each step and its reverse stand as far from the ends of the list."""
    moves = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    chosen: IntArray = moves[np.abs(moves).sum(axis=1) == 1] if connectivity == 6 else moves
    return chosen


def make_grid(space: FreeSpace, side: float, connectivity: int) -> Grid:
    """The grid that fills the bounds: whole voxels, centred in what is left over.

    A voxel is free if its centre keeps what the space asks, a step if the whole segment does.
    """
    extent = space.upper - space.lower
    inner = np.maximum(np.floor(extent / side + 1e-9).astype(np.int64), 1)
    lower = space.lower + 0.5 * (extent - (inner - 1) * side) - side
    shape, moves = inner + 2, moves_of(connectivity)
    costs = np.sqrt((moves**2).sum(axis=1).astype(np.float64))
    strides = moves @ np.array([shape[1] * shape[2], shape[2], 1])
    room = _room(space, lower, side, shape)
    grid = Grid(lower, side, shape, moves, costs, strides, room >= 0.0, np.zeros(len(room), dtype=np.uint32))
    _free_steps(space, grid, room)
    return grid


@compiled_lazily(error_model="numpy")
def center_of(grid: Grid, voxel: int) -> FloatArray:
    """Where the centre of a voxel is, (3,) m."""
    center = np.empty(3)
    rest = voxel
    for axis in range(2, -1, -1):
        center[axis] = grid.lower[axis] + grid.side * (rest % grid.shape[axis])
        rest //= grid.shape[axis]
    return center


@compiled_lazily(error_model="numpy")
def _room(space: FreeSpace, lower: FloatArray, side: float, shape: IntArray) -> FloatArray:
    """(V,) m, how much farther than needed each voxel's centre is from obstacles; negative where blocked, on the rim too."""
    room = np.full(shape[0] * shape[1] * shape[2], -1.0)
    for i in range(1, shape[0] - 1):
        x = lower[0] + side * i
        for j in range(1, shape[1] - 1):
            y = lower[1] + side * j
            for k in range(1, shape[2] - 1):
                z, least = lower[2] + side * k, np.inf
                for o in range(space.table.shape[0]):
                    # the circle around the footprint bounds the distance from below
                    flat = math.sqrt((space.table[o, X] - x) ** 2 + (space.table[o, Y] - y) ** 2) - space.reach[o]
                    if flat < least:
                        least = min(least, point_distance(space.table[o], x, y, z) - space.needs[o])
                room[(i * shape[1] + j) * shape[2] + k] = least
    return room


@compiled_lazily(error_model="numpy")
def _free_steps(space: FreeSpace, grid: Grid, room: FloatArray) -> None:
    """Fill ``grid.steps``: a step is clear where the room at both its ends adds up to its length (triangle inequality)."""
    num_moves = grid.moves.shape[0]
    guess = -1
    for voxel in range(room.shape[0]):
        if not grid.is_free[voxel]:
            continue
        for move in range(num_moves // 2, num_moves):
            other = voxel + grid.strides[move]
            if not grid.is_free[other]:
                continue
            if room[voxel] + room[other] < grid.costs[move] * grid.side:
                guess = blocker(space, center_of(grid, voxel), center_of(grid, other), guess)
                if guess >= 0:
                    continue
            grid.steps[voxel] |= np.uint32(1 << move)
            grid.steps[other] |= np.uint32(1 << (num_moves - 1 - move))


@compiled_lazily(error_model="numpy")
def linked_voxel(space: FreeSpace, grid: Grid, place: FloatArray) -> int:
    """The free voxel with the nearest centre that a place sees in a straight line, or -1 where none is near."""
    best, found = np.inf, -1
    at, base = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for axis in range(3):
        base[axis] = round((place[axis] - grid.lower[axis]) / grid.side)
    width = 2 * LINK_REACH + 1
    for code in range(width**3):
        rest, voxel, inside = code, 0, True
        for axis in range(3):
            at[axis] = base[axis] + rest % width - LINK_REACH
            rest //= width
            inside = inside and 0 < at[axis] < grid.shape[axis] - 1
            voxel = voxel * grid.shape[axis] + at[axis]
        if inside and grid.is_free[voxel]:
            center = center_of(grid, voxel)
            away = math.sqrt((center[0] - place[0]) ** 2 + (center[1] - place[1]) ** 2 + (center[2] - place[2]) ** 2)
            if away < best and blocker(space, place, center, -1) < 0:
                best, found = away, voxel
    return found


@compiled_lazily(error_model="numpy")
def dijkstra(grid: Grid, source: int, targets: IntArray) -> FloatArray:
    """Least cost from a voxel to each of the targets (Q,), in voxel sides; infinite where there is no way."""
    num_voxels, num_moves = grid.is_free.shape[0], grid.moves.shape[0]
    cost = np.full(num_voxels, np.inf)
    is_wanted = np.zeros(num_voxels, dtype=np.bool_)
    num_wanted = 0
    for target in targets:
        num_wanted += not is_wanted[target]
        is_wanted[target] = True
    # each bucket is a doubly linked list, so that a voxel whose cost falls moves from one to another
    head, after, before = np.full(NUM_BUCKETS, -1), np.empty(num_voxels, dtype=np.int64), np.empty(num_voxels, dtype=np.int64)
    cost[source], head[0], after[source], before[source] = 0.0, source, -1, -1
    num_open, bucket = 1, 0
    while num_open > 0 and num_wanted > 0:
        slot = bucket % NUM_BUCKETS
        while head[slot] >= 0:
            voxel = head[slot]
            head[slot] = after[voxel]
            if head[slot] >= 0:
                before[head[slot]] = -1
            num_open -= 1
            num_wanted -= is_wanted[voxel]
            steps = grid.steps[voxel]
            for move in range(num_moves):
                if not (steps >> move) & 1:
                    continue
                other, through = voxel + grid.strides[move], cost[voxel] + grid.costs[move]
                if through >= cost[other] - SAME_COST:
                    continue
                if cost[other] < np.inf:
                    _unlink(head, after, before, other, _bucket(cost[other]))
                else:
                    num_open += 1
                cost[other] = through
                _link(head, after, before, other, _bucket(through))
        bucket += 1
    result = np.empty(targets.shape[0])
    for index in range(targets.shape[0]):
        result[index] = cost[targets[index]]
    return result


@compiled_lazily(inline="always")
def _bucket(cost: float) -> int:
    return int(cost + SAME_COST) % NUM_BUCKETS


@compiled_lazily(inline="always")
def _link(head: IntArray, after: IntArray, before: IntArray, voxel: int, slot: int) -> None:
    after[voxel], before[voxel] = head[slot], -1
    if head[slot] >= 0:
        before[head[slot]] = voxel
    head[slot] = voxel


@compiled_lazily(inline="always")
def _unlink(head: IntArray, after: IntArray, before: IntArray, voxel: int, slot: int) -> None:
    if before[voxel] >= 0:
        after[before[voxel]] = after[voxel]
    else:
        head[slot] = after[voxel]
    if after[voxel] >= 0:
        before[after[voxel]] = before[voxel]


@compiled_lazily(error_model="numpy")
def astar(grid: Grid, source: int, target: int) -> IntArray:
    """The voxels of a cheapest way, both ends included; none where there is no way.

    Of equally cheap ways one with long straight runs: it is followed back straight on as long as that is free.
    """
    cost = np.full(grid.is_free.shape[0], np.inf)
    is_closed = np.zeros(grid.is_free.shape[0], dtype=np.bool_)
    goal = _place_of(grid, target)
    is_diagonal = grid.moves.shape[0] > 6
    cost[source] = 0.0
    # equal sums are taken from the far end, so that free space is crossed and not flooded
    queue = [(_to_go(grid, source, goal, is_diagonal), 0.0, source)]
    while len(queue) > 0:
        _, _, voxel = heapq.heappop(queue)
        if voxel == target:
            return _followed_back(grid, cost, source, target)
        if is_closed[voxel]:
            continue
        is_closed[voxel] = True
        steps = grid.steps[voxel]
        for move in range(grid.moves.shape[0]):
            if not (steps >> move) & 1:
                continue
            other, through = voxel + grid.strides[move], cost[voxel] + grid.costs[move]
            if through < cost[other] - SAME_COST:
                cost[other] = through
                heapq.heappush(queue, (through + _to_go(grid, other, goal, is_diagonal), -through, other))
    return np.empty(0, dtype=np.int64)


@compiled_lazily(inline="always")
def _place_of(grid: Grid, voxel: int) -> tuple[int, int, int]:
    layer = grid.shape[1] * grid.shape[2]
    return voxel // layer, voxel % layer // grid.shape[2], voxel % grid.shape[2]


@compiled_lazily(inline="always")
def _to_go(grid: Grid, voxel: int, goal: tuple[int, int, int], is_diagonal: bool) -> float:
    """What an empty grid costs from a voxel to the goal, in voxel sides."""
    x, y, z = _place_of(grid, voxel)
    a, b, c = abs(x - goal[0]), abs(y - goal[1]), abs(z - goal[2])
    if not is_diagonal:
        return float(a + b + c)
    low, high = min(a, b, c), max(a, b, c)
    middle = a + b + c - low - high
    return low * math.sqrt(3.0) + (middle - low) * math.sqrt(2.0) + (high - middle)


@compiled_lazily(error_model="numpy")
def _followed_back(grid: Grid, cost: FloatArray, source: int, target: int) -> IntArray:
    """The way that explains the target's cost, from the source."""
    way = [target]
    voxel, straight = target, -1
    while voxel != source:
        chosen = -1
        for move in range(grid.moves.shape[0]):
            other = voxel + grid.strides[move]
            leads_here = (grid.steps[voxel] >> move) & 1 and abs(cost[other] + grid.costs[move] - cost[voxel]) <= SAME_COST
            if leads_here and (chosen < 0 or move == straight):
                chosen = move
        voxel, straight = voxel + grid.strides[chosen], chosen
        way.append(voxel)
    return np.array(way[::-1])
