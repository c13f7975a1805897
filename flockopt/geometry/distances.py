"""One distance model: signed distances from points and segments to boxes, upright cylinders and spheres.

An obstacle is a row of nine numbers, so that numpy and the compiled twins in `flockopt.geometry.kernels` read the same
table (see `OBSTACLE_COLUMNS`). Distances are Euclidean, in metres, negative inside, and exact on both sides of
the surface. Since every shape is convex, its signed distance is a convex function of the point: along a
segment it has one minimum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from flockopt.records.arrays import FloatArray

__all__ = [
    "BOX", "COS_YAW", "CYLINDER", "HALF_X", "HALF_Y", "HALF_Z", "OBSTACLE_COLUMNS", "SHAPE", "SIN_YAW", "SPHERE", "X", "Y", "Z",
    "bounding_boxes", "distances", "surface_normals",
]  # fmt: skip

BOX, CYLINDER, SPHERE = 0, 1, 2

#: What the nine columns of an obstacle table hold. A cylinder has half_x = half_y = radius; a sphere has
#: half_x = half_y = half_z = radius.
OBSTACLE_COLUMNS = ("shape", "x", "y", "z", "half_x", "half_y", "half_z", "cos_yaw", "sin_yaw")

#: Where they are: a place's three columns begin at `X`, the half sizes' at `HALF_X`.
SHAPE, X, Y, Z, HALF_X, HALF_Y, HALF_Z, COS_YAW, SIN_YAW = range(len(OBSTACLE_COLUMNS))


def distances(table: FloatArray, points: ArrayLike) -> FloatArray:
    """Signed distance of every point to every obstacle.

    Args:
        table: (K, 9) obstacle table.
        points: (P, 3) m.

    Returns:
        (P, K) m, negative inside.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    shape, halves = table[:, SHAPE], table[:, HALF_X : HALF_Z + 1]
    local = _to_local(table, points)  # (P, K, 3)
    flat = np.hypot(local[..., 0], local[..., 1])  # (P, K) horizontal distance from the axis
    box_excess = np.abs(local) - halves
    round_excess = np.stack([flat - halves[:, 0], np.abs(local[..., 2]) - halves[:, 2]], axis=-1)
    sphere = np.hypot(flat, local[..., 2]) - halves[:, 0]
    return np.where(shape == BOX, _prism(box_excess), np.where(shape == CYLINDER, _prism(round_excess), sphere))


def _to_local(table: FloatArray, points: FloatArray) -> FloatArray:
    offset = points[:, None, :] - table[None, :, X : Z + 1]
    cos_yaw, sin_yaw = table[:, COS_YAW], table[:, SIN_YAW]
    x = cos_yaw * offset[..., 0] + sin_yaw * offset[..., 1]
    y = -sin_yaw * offset[..., 0] + cos_yaw * offset[..., 1]
    return np.stack([x, y, offset[..., 2]], axis=-1)


def _prism(excess: FloatArray) -> FloatArray:
    """Signed distance from per-axis excesses: outside the Euclidean norm, inside the nearest face."""
    outside = np.sqrt(np.sum(np.maximum(excess, 0.0) ** 2, axis=-1))
    return outside + np.minimum(np.max(excess, axis=-1), 0.0)


def surface_normals(table: FloatArray, points: ArrayLike, step: float = 1e-6) -> FloatArray:
    """Outward directions: the gradient of each signed distance by central differences, (P, K, 3)."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    columns = [
        (distances(table, points + step * axis) - distances(table, points - step * axis)) / (2 * step) for axis in np.eye(3)
    ]
    return np.stack(columns, axis=-1)


def bounding_boxes(table: FloatArray) -> FloatArray:
    """Axis-aligned bounding boxes, (K, 2, 3) m: lower and upper corners."""
    cos_yaw, sin_yaw = np.abs(table[:, COS_YAW]), np.abs(table[:, SIN_YAW])
    half_x, half_y, half_z = table[:, HALF_X : HALF_Z + 1].T
    turned = table[:, SHAPE] == BOX
    reach = np.stack(
        [
            np.where(turned, cos_yaw * half_x + sin_yaw * half_y, half_x),
            np.where(turned, sin_yaw * half_x + cos_yaw * half_y, half_y),
            half_z,
        ],
        axis=-1,
    )
    centre = table[:, X : Z + 1]
    return np.stack([centre - reach, centre + reach], axis=1)
