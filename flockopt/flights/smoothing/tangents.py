"""Half-spaces that keep a curve clear of obstacles, in continuous time and by linear inequalities.

The signed distance to a convex obstacle is a convex function of the point, so its tangent at any place bounds it from
below everywhere: where ``distance(x) + gradient(x) . (y - x)`` is enough, y is clear. A part of a polynomial piece lies
within the hull of its control points, so that inequalities on those keep all of that part clear. Parts are halved
until a tangent has all of their control points on its good side. Distances are those of `flockopt.geometry.kernels`, which the
judge uses too. The sides of the scene's bounds are half-spaces already.
"""

from __future__ import annotations

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_3, compiled_for, compiled_lazily
from flockopt.geometry.bernstein import halve
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.geometry.intervals import box_gap, fit_box
from flockopt.geometry.kernels import point_distance, point_gradient
from flockopt.records.arrays import FloatArray

__all__ = ["part_weights", "tangent_rows"]

#: Parts of a piece are at least 1 / 2 ** DEEPEST_PART of it.
DEEPEST_PART = 3

#: Parts of a piece by level and place: 1 + 2 + 4 + 8.
NUM_PARTS = 2 ** (DEEPEST_PART + 1) - 1


@compiled_for(types.int64)
def part_weights(num_terms: int) -> FloatArray:
    """Control points of a piece's dyadic parts as sums of its own: (parts, D, D), part 2 i + 1 the first half of i."""
    weights = np.zeros((NUM_PARTS, num_terms, num_terms))
    columns, left, right = np.empty((num_terms, num_terms)), np.empty((num_terms, num_terms)), np.empty((num_terms, num_terms))
    for i in range(num_terms):
        weights[0, i, i] = 1.0
    for part in range(NUM_PARTS // 2):
        columns[:] = weights[part].T  # one row for each original control point, as `halve` wants them
        halve(columns, left, right)
        weights[2 * part + 1] = left.T
        weights[2 * part + 2] = right.T
    return weights


@compiled_lazily()
def _keep(
    margins: FloatArray, rows: FloatArray, offsets: FloatArray,
    margin: float, normal: FloatArray, weights: FloatArray, offset: float,
) -> None:  # fmt: skip
    """Keep an inequality if it is among the tightest: it takes the place of the loosest one."""
    loosest = margins.argmax()
    if margin >= margins[loosest]:
        return
    margins[loosest], offsets[loosest] = margin, offset
    for axis in range(3):
        for i in range(weights.shape[0]):
            rows[loosest, axis, i] = normal[axis] * weights[i]


@compiled_lazily()
def _tangent(row: FloatArray, control: FloatArray, normal: FloatArray) -> float:
    """Fill ``normal`` with the gradient at the control point (3, D) nearest to an obstacle; the tangent's offset.

    The tangent is ``normal . y - offset``.
    """
    least, nearest = np.inf, 0
    for i in range(control.shape[1]):
        distance = point_distance(row, control[0, i], control[1, i], control[2, i])
        if distance < least:
            least, nearest = distance, i
    x, y, z = control[0, nearest], control[1, nearest], control[2, nearest]
    normal[0], normal[1], normal[2] = point_gradient(row, x, y, z)
    return normal[0] * x + normal[1] * y + normal[2] * z - least


@compiled_lazily()
def _bound_rows(
    control: FloatArray, space: FreeSpace, weights: FloatArray,
    margins: FloatArray, rows: FloatArray, offsets: FloatArray,
) -> None:  # fmt: skip
    """Keep the inequalities for one piece within the bounds."""
    normal = np.zeros(3)
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal[axis] = side
            offset = space.lower[axis] if side > 0.0 else -space.upper[axis]
            for i in range(control.shape[1]):
                margin = side * control[axis, i] - offset
                _keep(margins, rows, offsets, margin, normal, weights[i], min(offset, offset + margin))
        normal[axis] = 0.0


@compiled_lazily()
def _obstacle_rows(
    control: FloatArray,
    row: FloatArray,
    need: float,
    parts: FloatArray,
    margins: FloatArray,
    rows: FloatArray,
    offsets: FloatArray,
) -> None:
    """Keep the inequalities for one piece clear of one obstacle, part by part."""
    num_terms = control.shape[1]
    part_control, normal, gaps = np.empty((3, num_terms)), np.empty(3), np.empty(num_terms)
    stack = np.zeros(NUM_PARTS, dtype=np.int64)
    top = 1
    while top > 0:
        top -= 1
        part = stack[top]
        for axis in range(3):
            for i in range(num_terms):
                part_control[axis, i] = np.dot(parts[part, i], control[axis])
        offset = _tangent(row, part_control, normal) + need
        for i in range(num_terms):
            gaps[i] = normal[0] * part_control[0, i] + normal[1] * part_control[1, i] + normal[2] * part_control[2, i] - offset
        if gaps.min() < 0.0 and 2 * part + 2 < NUM_PARTS:
            stack[top], stack[top + 1] = 2 * part + 1, 2 * part + 2
            top += 2
        else:
            for i in range(num_terms):
                _keep(margins, rows, offsets, gaps[i], normal, parts[part, i], min(offset, offset + gaps[i]))


@compiled_for(FLOATS_3, FREE_SPACE, types.int64, types.float64)
def tangent_rows(control: FloatArray, space: FreeSpace, num_rows: int, reach: float) -> tuple[FloatArray, FloatArray]:
    """Inequalities under which a curve near the given one is clear of obstacles and within bounds.

    Args:
        control: (K, 3, D) m, the given curve's control points.
        space: What to keep clear of, and within.
        num_rows: Inequalities a piece, R >= 1; where there are more, the tightest are kept.
        reach: Metres; what has more room than this is not looked at.

    Returns:
        (K, R, 3, D) weights of the control points, and (K, R) m that each weighted sum is to reach. What the given
        curve breaks is relaxed so that it just holds. Where fewer inequalities are needed, weights are zero.
    """
    num_pieces, _, num_terms = control.shape
    rows, offsets = np.zeros((num_pieces, num_rows, 3, num_terms)), np.full((num_pieces, num_rows), -1.0)
    parts, box = part_weights(num_terms), np.empty((2, 3))
    for p in range(num_pieces):
        margins = np.full(num_rows, reach)
        _bound_rows(control[p], space, parts[0], margins, rows[p], offsets[p])
        fit_box(control[p], box)
        for k in range(space.table.shape[0]):
            if box_gap(box, space.boxes[k]) - space.needs[k] < reach:
                _obstacle_rows(control[p], space.table[k], space.needs[k], parts, margins, rows[p], offsets[p])
    return rows, offsets
