"""Local geometric correction: control points moved out of inflated obstacles, closer ones where a curve cuts in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from flockopt.geometry import FloatArray
from flockopt.kernels import point_distance, point_gradient
from flockopt.scene import Scene
from flockopt.trajectory.room import Room
from flockopt.trajectory.waypoints import Waypoints, anchored_legs, leg_clear, waypoints_from_paths
from flockopt.travel import END, START, Travel

__all__ = ["corrected", "corrected_samples", "densified"]

#: Obstacles are inflated by this share of the drone's radius beyond the distance that must be kept.
INFLATION = 0.5

#: Moves of one point at the most: it may be pushed from one obstacle into the next.
MOST_MOVES = 24

#: How often the gaps between samples are halved where a corrected leg is still blocked.
HALVINGS = 2


@njit(cache=True)
def _worst(point: FloatArray, table: FloatArray, boxes: FloatArray, needs: FloatArray, inflation: float) -> tuple[float, int]:
    """How deep a point is within the deepest inflated obstacle, metres, and which that is; (0, -1) if in none."""
    depth, deepest = 0.0, -1
    for k in range(table.shape[0]):
        reach = needs[k] + inflation
        outside = False
        for axis in range(3):
            if point[axis] <= boxes[k, 0, axis] - reach or point[axis] >= boxes[k, 1, axis] + reach:
                outside = True
        if not outside:
            inside = reach - point_distance(table[k], point[0], point[1], point[2])
            if inside > depth:
                depth, deepest = inside, k
    return depth, deepest


@njit(cache=True)
def _push_out(
    points: FloatArray, table: FloatArray, boxes: FloatArray, needs: FloatArray, lower: FloatArray, upper: FloatArray,
    inflation: float,
) -> FloatArray:  # fmt: skip
    """The points (P, 3), all but the first and last moved along the distance's gradient out of what they are in."""
    result = points.copy()
    for i in range(1, points.shape[0] - 1):
        point = result[i]
        before = _worst(point, table, boxes, needs, 0.0)[0]
        for _ in range(MOST_MOVES):
            depth, k = _worst(point, table, boxes, needs, inflation)
            if k < 0:
                break
            gradient = point_gradient(table[k], point[0], point[1], point[2])
            for axis in range(3):
                point[axis] = min(max(point[axis] + (depth + 1e-9) * gradient[axis], lower[axis]), upper[axis])
        if _worst(point, table, boxes, needs, 0.0)[0] > before:
            point[:] = points[i]
    return result


def corrected(control: FloatArray, room: Room, radius: float) -> FloatArray:
    """Control points (K, 3) with the inner ones moved out of inflated obstacles, as far as there is room."""
    return _push_out(control, room.table, room.boxes, room.needs, room.lower, room.upper, INFLATION * radius)


def densified(control: FloatArray) -> FloatArray:
    """Control points (2 K - 1, 3) with the middles between neighbours added."""
    result = np.empty((2 * len(control) - 1, 3))
    result[::2] = control
    result[1::2] = (control[:-1] + control[1:]) / 2
    return result


def corrected_samples(scene: Scene, travel: Travel, drone: int, route: Sequence[int], samples: FloatArray) -> Waypoints:
    """Waypoints through all of one drone's samples (T, 3), corrected; start, tasks and end are exact anchors.

    Unlike `waypoints_from_samples` it drops no samples: control points at even distances make even progress along
    a Catmull-Rom curve. Where a leg through the corrected samples is blocked, the any-angle path takes its place.
    """
    detour = waypoints_from_paths(scene, travel, drone, route)
    if not detour.moves:
        return detour
    record = scene.drones[drone]
    room = Room.around(scene, record, detour)
    stops = [START, *route] + ([END] if record.end_point is not None else [])
    legs = []
    for index, leg in enumerate(anchored_legs(scene, drone, route, samples)):
        moved = corrected(leg, room, record.radius)
        for _ in range(HALVINGS):
            if not leg_clear(scene, drone, moved):
                moved = corrected(densified(moved), room, record.radius)
        legs.append(moved if leg_clear(scene, drone, moved) else travel.path(drone, stops[index], stops[index + 1]))
    return Waypoints.join(scene, route, legs)
