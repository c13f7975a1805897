"""Merging corners: fewer, wider turns where a way bends twice in quick succession.

A shortest path rounds an obstacle's edge by two or more close waypoints. Flown through one after another they
cost speed and polynomial pieces; one waypoint where the two outer legs meet costs a little length instead.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flockopt.batches.compiled import FLOATS_1, compiled_for
from flockopt.flights.waypoints import FLY_THROUGH, Waypoints
from flockopt.geometry.free_space import FreeSpace, inside, segment_clear
from flockopt.records.arrays import FloatArray

__all__ = ["merged_corners"]

#: A merged corner may be farther from the two it replaces than they are from each other by this factor at most.
FARTHEST_MITRE = 4.0


@compiled_for(FLOATS_1, FLOATS_1, FLOATS_1, FLOATS_1)
def _mitre(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """Where the legs a-b and d-c, prolonged, meet or come nearest to each other; NaN where they are parallel."""
    u, v, w = b - a, c - d, b - c
    uu, uv, vv, uw, vw = u @ u, u @ v, v @ v, u @ w, v @ w
    determinant = uu * vv - uv * uv
    if determinant <= 1e-9 * uu * vv:
        return np.full(3, np.nan)
    along_u, along_v = (uv * vw - vv * uw) / determinant, (uu * vw - uv * uw) / determinant
    if along_u < 0.0 or along_v < 0.0:
        return np.full(3, np.nan)
    return 0.5 * (b + along_u * u + c + along_v * v)


def merged_corners(waypoints: Waypoints, space: FreeSpace) -> Iterator[Waypoints]:
    """The same way with two neighbouring corners merged into one, for every pair where that is clear."""
    points = waypoints.points
    for k in range(1, len(points) - 2):
        if any(waypoints.tasks[i] or waypoints.rest_s[i] != FLY_THROUGH for i in (k, k + 1)):
            continue
        a, b, c, d = points[k - 1 : k + 3]
        corner = _mitre(a, b, c, d)
        if not (np.maximum(np.abs(corner - b), np.abs(corner - c)).max() <= FARTHEST_MITRE * np.linalg.norm(c - b)):
            continue
        if inside(space, corner) and segment_clear(space, a, corner) and segment_clear(space, corner, d):
            yield Waypoints(
                np.vstack([points[:k], corner, points[k + 2 :]]),
                np.delete(waypoints.rest_s, k),
                waypoints.tasks[:k] + waypoints.tasks[k + 1 :],
            )
