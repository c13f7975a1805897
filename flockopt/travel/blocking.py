"""Compiled, closed-form answers to one question: does a segment come nearer to an obstacle than it may?

The same distances as `flockopt.geometry.kernels`, but only compared, never computed to the end: a path search asks this
question far more often than any other.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_1, compiled_for, compiled_lazily
from flockopt.geometry.distances import BOX, COS_YAW, CYLINDER, HALF_X, HALF_Y, HALF_Z, SHAPE, SIN_YAW, X, Y, Z
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.geometry.kernels import SEGMENT_TOLERANCE_M, segment_distance
from flockopt.records.arrays import FloatArray

__all__ = ["blocker", "too_near"]

#: Most steps towards the least distance to a rim; the squared distance is then exact to rounding.
RIM_STEPS = 14


@compiled_for(FREE_SPACE, FLOATS_1, FLOATS_1, types.int64, error_model="numpy")
def blocker(space: FreeSpace, p: FloatArray, q: FloatArray, guess: int) -> int:
    """An obstacle that the segment p-q comes too near to, or -1; ``guess`` (or -1) is tried first."""
    table, needs, reach = space.table, space.needs, space.reach
    if guess >= 0 and too_near(table, guess, needs[guess], p[0], p[1], p[2], q[0], q[1], q[2]):
        return guess
    x, y = p[0], p[1]
    dx, dy = q[0] - x, q[1] - y
    low, high = min(p[2], q[2]), max(p[2], q[2])
    squared = dx * dx + dy * dy
    length = math.sqrt(squared)
    for k in range(table.shape[0]):
        tall = table[k, HALF_Z] + needs[k]
        if low > table[k, Z] + tall or high < table[k, Z] - tall:
            continue
        across = reach[k] * length
        cx, cy = table[k, X] - x, table[k, Y] - y
        if abs(dx * cy - dy * cx) > across:
            continue
        ahead = dx * cx + dy * cy
        if ahead < -across or ahead > squared + across:
            continue
        if k != guess and too_near(table, k, needs[k], p[0], p[1], p[2], q[0], q[1], q[2]):
            return k
    return -1


@compiled_lazily(error_model="numpy")
def too_near(table: FloatArray, k: int, need: float, px: float, py: float, pz: float, qx: float, qy: float, qz: float) -> bool:
    """Whether the segment p-q comes nearer to obstacle k than ``need``, by more than the tolerance."""
    room = need - SEGMENT_TOLERANCE_M
    if room <= 0.0:
        return segment_distance(table[k], np.array([px, py, pz]), np.array([qx, qy, qz]), need, room) < room
    x, y, z, dx, dy, dz = px - table[k, X], py - table[k, Y], pz - table[k, Z], qx - px, qy - py, qz - pz
    if table[k, SHAPE] == BOX:
        return _box_too_near(table, k, room, x, y, z, dx, dy, dz)
    if table[k, SHAPE] == CYLINDER:
        return _cylinder_too_near(table[k, HALF_X], table[k, HALF_Z], room, x, y, z, dx, dy, dz)
    return _sphere_too_near(table[k, HALF_X] + room, x, y, z, dx, dy, dz)


@compiled_lazily(error_model="numpy")
def _within(low: float, high: float, x: float, d: float, limit: float) -> tuple[float, float]:
    """The part of low..high where ``abs(x + t d) < limit``; high below low if there is none."""
    if d == 0.0:
        return (low, high) if abs(x) < limit else (1.0, 0.0)
    first, second = (-limit - x) / d, (limit - x) / d
    if first > second:
        first, second = second, first
    return (first if first > low else low), (second if second < high else high)


@compiled_lazily(error_model="numpy")
def _pull(x: float, half: float) -> float:
    """How far x is outside -half..half, with its sign."""
    return x - half if x > half else (x + half if x < -half else 0.0)


@compiled_lazily(error_model="numpy")
def _box_too_near(
    table: FloatArray, k: int, room: float, px: float, py: float, pz: float, ox: float, oy: float, oz: float
) -> bool:
    """For a segment from p, as seen from the box's middle, by o.

    The squared distance is a convex, piecewise quadratic function along the segment.

    Its slope is piecewise linear and bends where a coordinate crosses a face: between the two bends around the
    minimum the slope's zero is found by one interpolation.
    """
    h0, h1, h2 = table[k, HALF_X], table[k, HALF_Y], table[k, HALF_Z]
    cos_yaw, sin_yaw = table[k, COS_YAW], table[k, SIN_YAW]
    x0, x1, x2 = cos_yaw * px + sin_yaw * py, cos_yaw * py - sin_yaw * px, pz
    d0, d1, d2 = cos_yaw * ox + sin_yaw * oy, cos_yaw * oy - sin_yaw * ox, oz
    low, high = _within(0.0, 1.0, x0, d0, h0 + room)
    if low >= high:
        return False
    low, high = _within(low, high, x1, d1, h1 + room)
    if low >= high:
        return False
    low, high = _within(low, high, x2, d2, h2 + room)
    if low >= high:
        return False
    at_low = _box_slope(h0, h1, h2, x0, x1, x2, d0, d1, d2, low)
    at_high = _box_slope(h0, h1, h2, x0, x1, x2, d0, d1, d2, high)
    best = low if at_low >= 0.0 else high
    if at_low < 0.0 < at_high:
        for face in range(6):
            if face < 2:
                x, d, half = x0, d0, h0
            elif face < 4:
                x, d, half = x1, d1, h1
            else:
                x, d, half = x2, d2, h2
            if d != 0.0:
                t = ((half if face % 2 == 0 else -half) - x) / d
                if low < t < high:
                    slope = _box_slope(h0, h1, h2, x0, x1, x2, d0, d1, d2, t)
                    if slope < 0.0:
                        low, at_low = t, slope
                    else:
                        high, at_high = t, slope
        best = low - at_low * (high - low) / (at_high - at_low)
    a, b, c = _pull(x0 + best * d0, h0), _pull(x1 + best * d1, h1), _pull(x2 + best * d2, h2)
    return a * a + b * b + c * c < room * room


@compiled_lazily(error_model="numpy")
def _box_slope(
    h0: float, h1: float, h2: float, x0: float, x1: float, x2: float, d0: float, d1: float, d2: float, t: float
) -> float:
    """Half the derivative of the squared distance to a box of half sizes h, along x + t d."""
    return _pull(x0 + t * d0, h0) * d0 + _pull(x1 + t * d1, h1) * d1 + _pull(x2 + t * d2, h2) * d2


@compiled_lazily(error_model="numpy")
def _cylinder_too_near(
    radius: float, half: float, room: float, x: float, y: float, z: float, dx: float, dy: float, dz: float
) -> bool:
    """For a segment from (x, y, z), as seen from the cylinder's middle, by (dx, dy, dz).

    Closed form beside the cylinder and over its flat ends; only near a rim the distance is iterated.
    """
    low, high = _within(0.0, 1.0, z, dz, half + room)
    if low >= high:
        return False
    a, b, c = dx * dx + dy * dy, x * dx + y * dy, x * x + y * y
    limit = radius + room
    if a > 0.0:
        root = b * b - a * (c - limit * limit)
        if root <= 0.0:
            return False
        root = math.sqrt(root)
        low, high = max(low, (-b - root) / a), min(high, (-b + root) / a)
    elif c >= limit * limit:
        return False
    if low >= high:
        return False
    # between low and high it is within the upright prism around the grown cylinder, of which only the rims are rounder
    up = 1.0 if z + 0.5 * (low + high) * dz > 0.0 else -1.0
    below_low, below_high = up * (z + low * dz) - half, up * (z + high * dz) - half
    if below_low <= 0.0 or below_high <= 0.0:
        return True
    # over the flat end: convex, and its slope (halved) changes sign at the minimum
    slope_low = _rim_slope(a, b, c, radius, low) + below_low * up * dz
    slope_high = _rim_slope(a, b, c, radius, high) + below_high * up * dz
    if slope_low >= 0.0 or slope_high <= 0.0:
        best = low if slope_low >= 0.0 else high
        return _rim_squared(a, b, c, radius, best) + (up * (z + best * dz) - half) ** 2 < room * room
    for _ in range(RIM_STEPS):
        best = (low * slope_high - high * slope_low) / (slope_high - slope_low)
        below = up * (z + best * dz) - half
        if _rim_squared(a, b, c, radius, best) + below * below < room * room:
            return True
        slope = _rim_slope(a, b, c, radius, best) + below * up * dz
        # false position, halving the slope at the end that stays (the Illinois rule)
        if slope < 0.0:
            low, slope_low, slope_high = best, slope, 0.5 * slope_high
        elif slope > 0.0:
            high, slope_high, slope_low = best, slope, 0.5 * slope_low
        else:
            break
    return False


@compiled_lazily(error_model="numpy")
def _rim_squared(a: float, b: float, c: float, radius: float, t: float) -> float:
    """Squared horizontal distance to the footprint where the squared distance to its axis is a t^2 + 2 b t + c."""
    outside = math.sqrt(max(a * t * t + 2.0 * b * t + c, 0.0)) - radius
    return outside * outside if outside > 0.0 else 0.0


@compiled_lazily(error_model="numpy")
def _rim_slope(a: float, b: float, c: float, radius: float, t: float) -> float:
    """Half the derivative of `_rim_squared`."""
    away = math.sqrt(max(a * t * t + 2.0 * b * t + c, 0.0))
    return (away - radius) * (a * t + b) / away if away > radius else 0.0


@compiled_lazily(error_model="numpy")
def _sphere_too_near(limit: float, x: float, y: float, z: float, dx: float, dy: float, dz: float) -> bool:
    """Whether a segment from (x, y, z), as seen from the centre, by (dx, dy, dz) comes nearer to it than ``limit``."""
    squared = dx * dx + dy * dy + dz * dz
    t = min(max(-(x * dx + y * dy + z * dz) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    x, y, z = x + t * dx, y + t * dy, z + t * dz
    return x * x + y * y + z * z < limit * limit
