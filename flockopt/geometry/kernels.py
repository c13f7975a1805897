"""Compiled twins of `flockopt.geometry.distances`: distances of one point or segment to one obstacle row.

Kept apart so that importing flockopt does not load numba. Every function is checked against the numpy form in
tests/unit/geometry/test_kernels.py. An obstacle row is as in `flockopt.geometry.distances.OBSTACLE_COLUMNS`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numpy.typing import ArrayLike

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, compiled_for, compiled_lazily
from flockopt.geometry.distances import BOX, COS_YAW, CYLINDER, HALF_X, HALF_Y, HALF_Z, SHAPE, SIN_YAW, X, Y, Z
from flockopt.records.arrays import FloatArray

__all__ = [
    "SEGMENT_TOLERANCE_M", "point_distance", "point_gradient", "segment_distance", "segment_distances", "segment_length",
    "segment_near_box",
]  # fmt: skip

#: A segment's least distance is found to this many metres.
SEGMENT_TOLERANCE_M = 1e-9


@compiled_lazily(inline="always")
def _signed_prism(a: float, b: float, c: float) -> float:
    outside = math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)
    return outside + min(max(a, b, c), 0.0)


@compiled_for(FLOATS_1, types.float64, types.float64, types.float64)
def point_distance(row: FloatArray, x: float, y: float, z: float) -> float:
    """Signed distance, metres, of a point to the obstacle; negative inside."""
    dx, dy, dz = x - row[X], y - row[Y], z - row[Z]
    if row[SHAPE] == BOX:
        a = abs(row[COS_YAW] * dx + row[SIN_YAW] * dy) - row[HALF_X]
        b = abs(-row[SIN_YAW] * dx + row[COS_YAW] * dy) - row[HALF_Y]
        return _signed_prism(a, b, abs(dz) - row[HALF_Z])
    if row[SHAPE] == CYLINDER:
        return _signed_prism(math.sqrt(dx * dx + dy * dy) - row[HALF_X], -np.inf, abs(dz) - row[HALF_Z])
    return math.sqrt(dx * dx + dy * dy + dz * dz) - row[HALF_X]


@compiled_lazily()
def _prism_gradient(a: float, b: float, c: float) -> tuple[float, float, float]:
    """Gradient of `_signed_prism` with respect to its three excesses."""
    pa, pb, pc = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    norm = math.sqrt(pa * pa + pb * pb + pc * pc)
    if norm > 0.0:
        return pa / norm, pb / norm, pc / norm
    if a >= b and a >= c:
        return 1.0, 0.0, 0.0
    return (0.0, 1.0, 0.0) if b >= c else (0.0, 0.0, 1.0)


@compiled_for(FLOATS_1, types.float64, types.float64, types.float64)
def point_gradient(row: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Gradient of `point_distance`: the outward direction; one of the subgradients where it has several."""
    dx, dy, dz = x - row[X], y - row[Y], z - row[Z]
    sign_z = 1.0 if dz >= 0.0 else -1.0
    if row[SHAPE] == BOX:
        u, v = row[COS_YAW] * dx + row[SIN_YAW] * dy, -row[SIN_YAW] * dx + row[COS_YAW] * dy
        ga, gb, gc = _prism_gradient(abs(u) - row[HALF_X], abs(v) - row[HALF_Y], abs(dz) - row[HALF_Z])
        ga *= 1.0 if u >= 0.0 else -1.0
        gb *= 1.0 if v >= 0.0 else -1.0
        return row[COS_YAW] * ga - row[SIN_YAW] * gb, row[SIN_YAW] * ga + row[COS_YAW] * gb, gc * sign_z
    if row[SHAPE] == CYLINDER:
        flat = math.sqrt(dx * dx + dy * dy)
        ga, _, gc = _prism_gradient(flat - row[HALF_X], -np.inf, abs(dz) - row[HALF_Z])
        if flat == 0.0:
            return ga, 0.0, gc * sign_z
        return ga * dx / flat, ga * dy / flat, gc * sign_z
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    if norm == 0.0:
        return 1.0, 0.0, 0.0
    return dx / norm, dy / norm, dz / norm


@compiled_for(FLOATS_1, FLOATS_1)
def segment_length(p: FloatArray, q: FloatArray) -> float:
    """Metres between two points."""
    return math.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2)


@compiled_for(FLOATS_1, FLOATS_1, FLOATS_1, types.float64, types.float64)
def segment_distance(row: FloatArray, p: FloatArray, q: FloatArray, enough: float, too_little: float) -> float:
    """Least signed distance of the segment p-q to the obstacle.

    The distance along a segment is convex, so tangents at both ends of a bracket bound it from below and their
    meeting point is the next place to look. The search stops early once the least distance is known to be at
    least ``enough`` (then a lower bound is returned) or at most ``too_little`` (then an upper bound is).
    """
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    low, high = 0.0, 1.0
    f_low = point_distance(row, p[0], p[1], p[2])
    f_high = point_distance(row, q[0], q[1], q[2])
    best = min(f_low, f_high)
    if best <= too_little:
        return best
    g = point_gradient(row, p[0], p[1], p[2])
    g_low = g[0] * dx + g[1] * dy + g[2] * dz
    g = point_gradient(row, q[0], q[1], q[2])
    g_high = g[0] * dx + g[1] * dy + g[2] * dz
    if g_low >= 0.0 or g_high <= 0.0:
        return best
    for _ in range(60):
        # where the two tangents meet, and how low they are there
        middle = (f_high - g_high * high - f_low + g_low * low) / (g_low - g_high)
        bound = f_low + g_low * (middle - low)
        if bound >= enough:
            return bound
        if best - bound <= SEGMENT_TOLERANCE_M:
            return best
        middle = min(max(middle, low + 0.05 * (high - low)), high - 0.05 * (high - low))
        x, y, z = p[0] + middle * dx, p[1] + middle * dy, p[2] + middle * dz
        f = point_distance(row, x, y, z)
        best = min(best, f)
        if best <= too_little:
            return best
        g = point_gradient(row, x, y, z)
        slope = g[0] * dx + g[1] * dy + g[2] * dz
        if slope == 0.0:
            return best
        if slope > 0.0:
            high, f_high, g_high = middle, f, slope
        else:
            low, f_low, g_low = middle, f, slope
    return best


@compiled_lazily()
def segment_near_box(box: FloatArray, reach: float, p: FloatArray, q: FloatArray) -> bool:
    """Whether the segment meets the bounding box grown by ``reach`` (slab test)."""
    enter, leave = 0.0, 1.0
    for axis in range(3):
        low, high = box[0, axis] - reach, box[1, axis] + reach
        a, b = p[axis], q[axis]
        if (a < low and b < low) or (a > high and b > high):
            return False
        step = b - a
        if step != 0.0:
            first, second = (low - a) / step, (high - a) / step
            if first > second:
                first, second = second, first
            enter, leave = max(enter, first), min(leave, second)
            if enter > leave:
                return False
    return True


@compiled_for(FLOATS_2, FLOATS_2, FLOATS_2)
def _segment_distances(table: FloatArray, starts: FloatArray, ends: FloatArray) -> FloatArray:
    """Least signed distance of every segment (P, 3)-(P, 3) to every obstacle, (P, K) m."""
    result = np.empty((starts.shape[0], table.shape[0]))
    for i in range(starts.shape[0]):
        for k in range(table.shape[0]):
            result[i, k] = segment_distance(table[k], starts[i], ends[i], np.inf, -np.inf)
    return result


def segment_distances(table: FloatArray, starts: ArrayLike, ends: ArrayLike) -> FloatArray:
    """Least signed distance of every segment to every obstacle, exact to 1e-9 m.

    Args:
        table: (K, 9) obstacle table.
        starts: (P, 3) m.
        ends: (P, 3) m.

    Returns:
        (P, K) m, negative where the segment enters the obstacle.
    """
    starts = np.ascontiguousarray(np.asarray(starts, dtype=np.float64).reshape(-1, 3))
    ends = np.ascontiguousarray(np.asarray(ends, dtype=np.float64).reshape(-1, 3))
    return _segment_distances(table, starts, ends)
