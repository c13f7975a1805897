"""Which polylines are clear, compiled: the twins of `leg_clear` and `thinned` in `flockopt.flights.waypoints`.

Kept apart so that numba loads late. tests/unit/learned/test_student_kernels.py checks every function against its plain form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from flockopt.geometry.kernels import segment_clear
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

__all__ = ["Obstructions", "length", "obstructions", "polyline_is_clear", "segment_is_clear", "thinned"]


class Obstructions(NamedTuple):
    """What a fleet keeps clear of: N drones, K obstacles; metres."""

    table: FloatArray  # (K, 9) rows as in `flockopt.geometry.distances.OBSTACLE_COLUMNS`
    boxes: FloatArray  # (K, 2, 3) their bounding boxes
    needs: FloatArray  # (N, K) how far each drone's centre stays from each obstacle
    lower: FloatArray  # (3,)
    upper: FloatArray  # (3,)


def obstructions(scene: Scene) -> Obstructions:
    """A scene's."""
    needs = np.repeat((scene.radii + scene.clearance)[:, None], len(scene.obstacles), axis=1)
    lower, upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    return Obstructions(scene.obstacle_table, scene.obstacle_boxes, needs, lower, upper)


@njit(cache=True)
def segment_is_clear(space: Obstructions, drone: int, p: FloatArray, q: FloatArray) -> bool:
    """Whether the segment p-q, (3,) m each, stays within bounds and as far from all obstacles as the drone must."""
    for axis in range(3):
        if min(p[axis], q[axis]) < space.lower[axis] or max(p[axis], q[axis]) > space.upper[axis]:
            return False
    return segment_clear(space.table, space.boxes, space.needs[drone], p, q)


@njit(cache=True)
def polyline_is_clear(space: Obstructions, drone: int, points: FloatArray) -> bool:
    """The same of every segment of a polyline (V, 3) m."""
    for index in range(len(points) - 1):  # noqa: SIM110 - numba has no generators
        if not segment_is_clear(space, drone, points[index], points[index + 1]):
            return False
    return True


@njit(cache=True)
def thinned(points: FloatArray, tolerance: float) -> FloatArray:
    """The polyline (V, 3) m without vertices closer than ``tolerance`` to it (Ramer 1972, Douglas and Peucker 1973)."""
    kept = np.zeros(len(points), dtype=np.bool_)
    kept[0] = kept[-1] = True
    pending = [(0, len(points) - 1)]
    while pending:
        first, last = pending.pop()
        worst, gap = _farthest_from_chord(points, first, last)
        if gap > tolerance:
            kept[worst] = True
            pending.append((first, worst))
            pending.append((worst, last))
    return points[kept]


@njit(cache=True)
def _farthest_from_chord(points: FloatArray, first: int, last: int) -> tuple[int, float]:
    """The vertex between two others that is farthest from their chord, and how far it is, metres; -1 without any."""
    chord = points[last] - points[first]
    square = max(_dot(chord, chord), 1e-12)
    worst, most = -1, -1.0
    for index in range(first + 1, last):
        offset = points[index] - points[first]
        away = offset - min(max(_dot(offset, chord) / square, 0.0), 1.0) * chord
        gap = math.sqrt(_dot(away, away))
        if gap > most:
            worst, most = index, gap
    return worst, most


@njit(cache=True)
def length(points: FloatArray) -> float:
    """Metres of a polyline (V, 3)."""
    total = 0.0
    for index in range(len(points) - 1):
        step = points[index + 1] - points[index]
        total += math.sqrt(_dot(step, step))
    return total


@njit(cache=True)
def _dot(a: FloatArray, b: FloatArray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
