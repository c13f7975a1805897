"""Free space: where the centre of one kind of drone may be, and whether segments and polylines stay there.

Paths, flights, drawn samples and the judge all keep to the same: so far from every obstacle, and within the bounds.
Compiled functions take it as one record. Its arrays are its own, C-ordered and writable, so that numba sees one type
of record, and compiles each of these functions once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, FLOATS_3, compiled_for, compiled_lazily, record_of
from flockopt.geometry.distances import BOX, HALF_X, HALF_Y, HALF_Z, SHAPE, SPHERE, X, bounding_boxes
from flockopt.geometry.kernels import SEGMENT_TOLERANCE_M, segment_distance, segment_near_box
from flockopt.records.arrays import FloatArray

__all__ = ["FREE_SPACE", "FreeSpace", "free_space", "inside", "may_meet", "polyline_free", "segment_clear", "segment_free"]


class FreeSpace(NamedTuple):
    """What a drone keeps clear of, K obstacles, and the bounds it stays within."""

    table: FloatArray  # (K, 9) obstacle rows, see `flockopt.geometry.distances.OBSTACLE_COLUMNS`
    boxes: FloatArray  # (K, 2, 3) m, their bounding boxes
    needs: FloatArray  # (K,) m, how far the drone's centre stays from each
    reach: FloatArray  # (K,) m, radius of the circle around each footprint grown by what it needs
    lower: FloatArray  # (3,) m, bounds
    upper: FloatArray  # (3,) m


#: The record's type in compiled signatures.
FREE_SPACE = record_of(FreeSpace, FLOATS_2, FLOATS_3, *[FLOATS_1] * 4)


def free_space(table: ArrayLike, needs: ArrayLike, bounds: ArrayLike, boxes: ArrayLike | None = None) -> FreeSpace:
    """The free space among obstacles.

    Args:
        table: (K, 9) obstacle rows.
        needs: Metres to keep from each, (K,) or one number for all.
        bounds: (2, 3) m or (lower, upper).
        boxes: (K, 2, 3) m, the obstacles' bounding boxes if they are there already.
    """
    own = np.array(table, dtype=np.float64, order="C")
    around = np.array(bounding_boxes(own) if boxes is None else boxes, dtype=np.float64, order="C")
    kept = np.full(len(own), needs, dtype=np.float64)
    footprint = np.where(own[:, SHAPE] == BOX, np.hypot(own[:, HALF_X], own[:, HALF_Y]), own[:, HALF_X])
    lower, upper = np.array(bounds, dtype=np.float64)
    return FreeSpace(own, around, kept, footprint + kept, lower, upper)


@compiled_for(FREE_SPACE, FLOATS_1)
def inside(space: FreeSpace, point: FloatArray) -> bool:
    """Whether a point (3,) m is within the bounds."""
    for axis in range(3):  # noqa: SIM110 - numba has no generators
        if point[axis] < space.lower[axis] or point[axis] > space.upper[axis]:
            return False
    return True


@compiled_lazily(error_model="numpy")
def may_meet(space: FreeSpace, k: int, lower: FloatArray, upper: FloatArray) -> bool:
    """Whether obstacle k, grown by what is to be kept from it, may reach into the box from ``lower`` to ``upper``.

    Asked of the circle around the footprint: what it lets pass is looked at more closely.
    """
    for axis in range(3):
        upright = axis == 2 and space.table[k, SHAPE] != SPHERE
        room = space.table[k, HALF_Z] + space.needs[k] if upright else space.reach[k]
        place = space.table[k, X + axis]
        if lower[axis] > place + room or upper[axis] < place - room:
            return False
    return True


@compiled_for(FREE_SPACE, FLOATS_1, FLOATS_1)
def segment_clear(space: FreeSpace, p: FloatArray, q: FloatArray) -> bool:
    """Whether the segment between two points (3,) m is as far from every obstacle as it must; bounds do not count."""
    for k in range(space.table.shape[0]):
        need = space.needs[k]
        if segment_near_box(space.boxes[k], need, p, q):
            least = segment_distance(space.table[k], p, q, need, need - 1e-12)
            if least < need - SEGMENT_TOLERANCE_M:
                return False
    return True


@compiled_lazily()
def segment_free(space: FreeSpace, p: FloatArray, q: FloatArray) -> bool:
    """Whether the segment between two points (3,) m is clear and within the bounds."""
    return inside(space, p) and inside(space, q) and segment_clear(space, p, q)


@compiled_for(FREE_SPACE, FLOATS_2)
def polyline_free(space: FreeSpace, points: FloatArray) -> bool:
    """Whether all of a polyline (V, 3) m is clear and within the bounds."""
    for i in range(len(points)):
        if not inside(space, points[i]):
            return False
    for i in range(len(points) - 1):  # noqa: SIM110 - numba has no generators
        if not segment_clear(space, points[i], points[i + 1]):
            return False
    return True
