"""What the samples of one drone's straight way are told of their surroundings: `learned.student.network.leg_frame`, compiled.

For inference, where many small tensor operations would take longer than the network. Same features, float64 inside.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.geometry.distances import BOX, COS_YAW, CYLINDER, HALF_X, SHAPE, SIN_YAW, X, Y, Z
from flockopt.geometry.free_space import FreeSpace
from flockopt.geometry.kernels import point_distance, point_gradient
from flockopt.records.arrays import FloatArray, IntArray
from learned.student.network.leg_frame import LEAST_UNIT_M, NEEDS_PER_UNIT, NUM_OWN, NUM_PER_OBSTACLE, REACH
from learned.student.scenes.batch import FAR_AWAY_M, MOST_OBSTACLES, THINNING

__all__ = ["add_residuals", "told_of"]


@compiled_lazily()
def told_of(
    space: FreeSpace, need: float, leg_begin: IntArray, leg_end: IntArray, blocked: NDArray[np.bool_],
    straight: FloatArray, nearest: int,
) -> NDArray[np.float32]:  # fmt: skip
    """(T, 3 + 13 + 15 nearest) features of one drone's samples: twin of `learned.student.network.leg_frame.sample_features`.

    Before them are three zeros, in the place of the noisy sample that the denoiser reads with them.

    Args:
        space: Obstacles and bounds.
        need: How far the drone's centre stays from obstacles, metres.
        leg_begin: (T,),
        leg_end: (T,),
        blocked: (T,) and
        straight: (T, 3) m of the drone, see `learned.student.scenes.examples.Example`.
        nearest: Of how many obstacles each sample is told.
    """
    unit = max(NEEDS_PER_UNIT * need, LEAST_UNIT_M)
    table = _near_blocked_legs(space.table, blocked, straight)
    features = np.zeros((len(straight), 3 + NUM_OWN + nearest * NUM_PER_OBSTACLE), dtype=np.float32)
    for sample in range(len(straight)):
        begin, end = leg_begin[sample], leg_end[sample]
        axes, leg_m = leg_axes(straight[begin], straight[end])
        phase, row, point = (sample - begin) / max(end - begin, 1), features[sample, 3:], straight[sample]
        row[0], row[1], row[2], row[3] = phase, phase * (1.0 - phase), math.log1p(leg_m / unit), blocked[sample]
        for axis in range(3):
            row[4 + axis] = axes[0, axis]
            row[7 + axis] = min((point[axis] - space.lower[axis]) / unit, REACH)
            row[10 + axis] = min((space.upper[axis] - point[axis]) / unit, REACH)
        _tell_of_obstacles(table, need, unit, axes, point, row[NUM_OWN:])
    return features


@compiled_lazily()
def _near_blocked_legs(table: FloatArray, blocked: NDArray[np.bool_], straight: FloatArray) -> FloatArray:
    """Rows of the obstacles nearest to the blocked legs, at most `MOST_OBSTACLES`, in the table's order."""
    if len(table) <= MOST_OBSTACLES:
        return table
    gaps = np.full(len(table), FAR_AWAY_M)
    for sample in range(0, len(straight), THINNING):
        if blocked[sample]:
            x, y, z = straight[sample]
            for k in range(len(table)):
                gaps[k] = min(gaps[k], point_distance(table[k], x, y, z))
    return table[np.sort(np.argsort(gaps, kind="mergesort")[:MOST_OBSTACLES])]


@compiled_lazily()
def leg_axes(p: FloatArray, q: FloatArray) -> tuple[FloatArray, float]:
    """Rows along the leg p-q, level across it and up from both, (3, 3); and its length, metres."""
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    leg_m = math.sqrt(dx * dx + dy * dy + dz * dz)
    size = max(leg_m, 1e-6)
    x, y, z = dx / size, dy / size, dz / size
    flat = math.sqrt(x * x + y * y)
    u, v = (-y / flat, x / flat) if flat > 1e-4 else (0.0, 1.0)
    return np.array([[x, y, z], [u, v, 0.0], [-z * v, z * u, x * v - y * u]]), leg_m


@compiled_lazily()
def _tell_of_obstacles(
    table: FloatArray, need: float, unit: float, axes: FloatArray, point: FloatArray, row: NDArray[np.float32]
) -> None:
    """Fill a row (nearest * 15,) with room, way out, centre, half extents, kind and turn of each obstacle, nearest first."""
    x, y, z = point
    gaps = np.array([point_distance(table[k], x, y, z) for k in range(len(table))])
    for rank in range(len(row) // NUM_PER_OBSTACLE):
        part = row[rank * NUM_PER_OBSTACLE : (rank + 1) * NUM_PER_OBSTACLE]
        part[0] = REACH
        if rank >= len(table):
            continue
        k = gaps.argmin()
        room, gaps[k] = (gaps[k] - need) / unit, math.inf
        if room < REACH:
            part[0] = room
            _tell_of_one(table[k], unit, axes, point, part)


@compiled_lazily()
def _tell_of_one(obstacle: FloatArray, unit: float, axes: FloatArray, point: FloatArray, part: NDArray[np.float32]) -> None:
    """Fill all but the first of an obstacle's features, (15,)."""
    gx, gy, gz = point_gradient(obstacle, point[0], point[1], point[2])
    cx, cy, cz = obstacle[X] - point[0], obstacle[Y] - point[1], obstacle[Z] - point[2]
    for axis in range(3):
        part[1 + axis] = axes[axis, 0] * gx + axes[axis, 1] * gy + axes[axis, 2] * gz
        centre = (axes[axis, 0] * cx + axes[axis, 1] * cy + axes[axis, 2] * cz) / unit
        part[4 + axis] = min(max(centre, -REACH), REACH)
        part[7 + axis] = min(obstacle[HALF_X + axis] / unit, REACH)
    part[10 if obstacle[SHAPE] == BOX else 11 if obstacle[SHAPE] == CYLINDER else 12] = 1.0
    if obstacle[SHAPE] == BOX:
        cos_leg, sin_leg, cos_yaw, sin_yaw = axes[1, 1], -axes[1, 0], obstacle[COS_YAW], obstacle[SIN_YAW]
        cos_two, sin_two = cos_leg * cos_leg - sin_leg * sin_leg, 2.0 * cos_leg * sin_leg
        cos_own, sin_own = cos_yaw * cos_yaw - sin_yaw * sin_yaw, 2.0 * cos_yaw * sin_yaw
        part[13] = cos_own * cos_two + sin_own * sin_two
        part[14] = sin_own * cos_two - cos_own * sin_two


@compiled_lazily()
def add_residuals(
    need: float, leg_begin: IntArray, leg_end: IntArray, straight: FloatArray, residuals: NDArray[np.float32]
) -> FloatArray:
    """(C, T, 3) m: tries from their residuals (C, T, 3): twin of `learned.student.network.leg_frame.to_points`."""
    unit = max(NEEDS_PER_UNIT * need, LEAST_UNIT_M)
    points = np.empty(residuals.shape)
    for sample in range(len(straight)):
        begin, end = leg_begin[sample], leg_end[sample]
        axes, _ = leg_axes(straight[begin], straight[end])
        scale = unit if begin < sample < end else 0.0
        for index in range(len(residuals)):
            for axis in range(3):
                offset = 0.0
                for along in range(3):
                    offset += residuals[index, sample, along] * axes[along, axis]
                points[index, sample, axis] = straight[sample, axis] + scale * offset
    return points
