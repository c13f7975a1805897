"""Branch and bound over the time of one piece: the engine under `flockopt.geometry.continuous`.

Best values come from the intervals' ends, where the curve is known; bounds from its control points (Lane and Riesenfeld,
"Bounds on a polynomial", 1981, find roots so). Both meet quadratically as intervals are halved.

On an interval a curve lies within its `deviation` from its chord (its control points do, and the tube around a
segment is convex). The signed distance to a convex obstacle is convex along the chord, so tangents at the
chord's ends bound it from below; the chord's distance from the origin is known in closed form. An interval
whose bound cannot lower the answer is dropped, any other is halved. Intervals wait on a stack of control points
(`new_stack`) with their spans, (start, width) as fractions of the piece.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_2, compiled_for, compiled_lazily, writable
from flockopt.geometry.bernstein import DEEPEST, MOST_INTERVALS, NARROWEST, copy_piece, halve
from flockopt.geometry.kernels import point_distance, point_gradient
from flockopt.records.arrays import FloatArray

__all__ = [
    "box_gap",
    "chord_bound",
    "deviation",
    "end_norm",
    "first_inside",
    "fit_box",
    "least_clearance_below",
    "least_norm_below",
    "new_stack",
    "split",
]

#: The first moment inside is found to this many seconds.
FIRST_TIME_S = 1e-3


@compiled_lazily()
def new_stack(num_terms: int) -> tuple[FloatArray, FloatArray]:
    """Room for the intervals of one piece: control points (S, 3, D) and spans (S, 2)."""
    return np.empty((DEEPEST + 3, 3, num_terms)), np.empty((DEEPEST + 3, 2))


@compiled_lazily()
def deviation(node: FloatArray) -> float:
    """How far from the chord between its ends an interval's curve (3, D) may be, metres."""
    last = node.shape[1] - 1
    dx, dy, dz = node[0, last] - node[0, 0], node[1, last] - node[1, 0], node[2, last] - node[2, 0]
    square = dx * dx + dy * dy + dz * dz
    largest = 0.0
    for i in range(1, last):
        x, y, z = node[0, i] - node[0, 0], node[1, i] - node[1, 0], node[2, i] - node[2, 0]
        # From the segment, not from its line: a curve that turns back goes beyond the chord's ends.
        along = min(max((x * dx + y * dy + z * dz) / square, 0.0), 1.0) if square > 0.0 else 0.0
        x, y, z = x - along * dx, y - along * dy, z - along * dz
        largest = max(largest, x * x + y * y + z * z)
    return math.sqrt(largest)


@compiled_lazily()
def split(stack: FloatArray, spans: FloatArray, top: int) -> None:
    """Replace the interval on ``top`` of the stack by its halves, the earlier one uppermost."""
    # The later half takes the interval's own place: depth-first, so that the stack is as deep as intervals are halved.
    halve(stack[top], stack[top + 1], stack[top])
    half = 0.5 * spans[top, 1]
    spans[top + 1, 0], spans[top + 1, 1] = spans[top, 0], half
    spans[top, 0], spans[top, 1] = spans[top, 0] + half, half


@compiled_for(FLOATS_2, writable(FLOATS_2))
def fit_box(piece: FloatArray, box: FloatArray) -> None:
    """Fill ``box`` (2, 3) with the bounding box of a piece's control points (3, D)."""
    for axis in range(3):
        box[0, axis], box[1, axis] = piece[axis, 0], piece[axis, 0]
        for i in range(1, piece.shape[1]):
            box[0, axis] = min(box[0, axis], piece[axis, i])
            box[1, axis] = max(box[1, axis], piece[axis, i])


@compiled_for(FLOATS_2, FLOATS_2)
def box_gap(a: FloatArray, b: FloatArray) -> float:
    """Least distance between two boxes (2, 3), metres; -inf where they meet."""
    square, apart = 0.0, False
    for axis in range(3):
        excess = max(b[0, axis] - a[1, axis], a[0, axis] - b[1, axis])
        if excess > 0.0:
            square += excess * excess
            apart = True
    return math.sqrt(square) if apart else -np.inf


@compiled_for(FLOATS_2, types.int64)
def end_norm(node: FloatArray, end: int) -> float:
    """Distance from the origin of control point ``end`` of (3, D)."""
    x, y, z = node[0, end], node[1, end], node[2, end]
    return math.sqrt(x * x + y * y + z * z)


@compiled_lazily()
def chord_bound(node: FloatArray) -> float:
    """Least possible distance from the origin of an interval's curve (3, D)."""
    last = node.shape[1] - 1
    x, y, z = node[0, 0], node[1, 0], node[2, 0]
    dx, dy, dz = node[0, last] - x, node[1, last] - y, node[2, last] - z
    square = dx * dx + dy * dy + dz * dz
    along = min(max(-(x * dx + y * dy + z * dz) / square, 0.0), 1.0) if square > 0.0 else 0.0
    x, y, z = x + along * dx, y + along * dy, z + along * dz
    return math.sqrt(x * x + y * y + z * z) - deviation(node)


@compiled_lazily()
def least_clearance_below(
    piece: FloatArray, row: FloatArray, need: float, best: float, tolerance: float, stop_below: float,
    stack: FloatArray, spans: FloatArray,
) -> tuple[float, float, float]:  # fmt: skip
    """Least margin of one piece (3, D) to one obstacle, where it is below ``best``; stops below ``stop_below``.

    Returns:
        The least margin met (``best`` if none is below it), where on the piece in [0, 1] (-1 if none), and a
        lower bound of the margin over the whole piece, within ``tolerance`` of the least one or of ``best``.
    """
    last = piece.shape[1] - 1
    where, proven = -1.0, np.inf
    copy_piece(piece, stack[0])
    spans[0, 0], spans[0, 1] = 0.0, 1.0
    top, looked = 1, 0
    while top > 0:
        top -= 1
        looked += 1
        node = stack[top]
        px, py, pz = node[0, 0], node[1, 0], node[2, 0]
        qx, qy, qz = node[0, last], node[1, last], node[2, last]
        f_p, f_q = point_distance(row, px, py, pz) - need, point_distance(row, qx, qy, qz) - need
        if f_p < best:
            best, where = f_p, spans[top, 0]
        if f_q < best:
            best, where = f_q, spans[top, 0] + spans[top, 1]
        if best < stop_below:
            return best, where, -np.inf
        ax, ay, az = point_gradient(row, px, py, pz)
        bx, by, bz = point_gradient(row, qx, qy, qz)
        # The distance to a convex obstacle is convex along the chord, so it lies above its tangents at both ends.
        slope_p = ax * (qx - px) + ay * (qy - py) + az * (qz - pz)
        slope_q = bx * (qx - px) + by * (qy - py) + bz * (qz - pz)
        bound = min(f_p, f_q)
        if slope_p < 0.0 < slope_q:  # where the tangents meet
            bound = f_p + slope_p * (f_q - slope_q - f_p) / (slope_p - slope_q)
        bound -= deviation(node)  # the distance changes by no more than the place does
        # What is given up for its width or for their number still counts with its bound: the proof never says too much.
        if bound >= best - tolerance or spans[top, 1] < NARROWEST or looked > MOST_INTERVALS:
            proven = min(proven, bound)
        else:
            split(stack, spans, top)
            top += 2
    return best, where, proven


@compiled_lazily()
def least_norm_below(best: float, tolerance: float, stack: FloatArray, spans: FloatArray) -> tuple[float, float, float]:
    """Least distance from the origin of the curve at ``stack[0]``: least met, where (-1: not below best), bound."""
    last = stack.shape[2] - 1
    where, proven = -1.0, np.inf
    spans[0, 0], spans[0, 1] = 0.0, 1.0
    top, looked = 1, 0
    while top > 0:
        top -= 1
        looked += 1
        first, final = end_norm(stack[top], 0), end_norm(stack[top], last)
        if first < best:
            best, where = first, spans[top, 0]
        if final < best:
            best, where = final, spans[top, 0] + spans[top, 1]
        bound = chord_bound(stack[top])
        if bound >= best - tolerance or spans[top, 1] < NARROWEST or looked > MOST_INTERVALS:
            proven = min(proven, bound)
        else:
            split(stack, spans, top)
            top += 2
    return best, where, proven


@compiled_lazily()
def first_inside(duration: float, graze: float, stack: FloatArray, spans: FloatArray) -> float:
    """Where in [0, 1] the curve at ``stack[0]`` first comes within 1 of the origin; -1 if it stays out."""
    last = stack.shape[2] - 1
    spans[0, 0], spans[0, 1] = 0.0, 1.0
    top, looked = 1, 0
    while top > 0:
        top -= 1
        looked += 1
        start, width = spans[top, 0], spans[top, 1]
        # The earlier half always is uppermost, so that the first interval that holds a moment inside holds the first one.
        if chord_bound(stack[top]) >= 1.0 - graze:
            continue
        if end_norm(stack[top], 0) < 1.0 - 0.5 * graze or looked > MOST_INTERVALS:
            return start
        if width * duration < FIRST_TIME_S and end_norm(stack[top], last) < 1.0 - 0.5 * graze:
            return start + width
        if width >= NARROWEST:
            split(stack, spans, top)
            top += 2
    return -1.0
