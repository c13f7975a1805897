"""Local geometric correction: control points moved out of inflated obstacles, closer ones where a curve cuts in."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, compiled_for
from flockopt.flights.room import Room
from flockopt.flights.waypoints import CHORD_TOLERANCE, Waypoints, anchored_legs, waypoints_from_paths
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace, polyline_free
from flockopt.geometry.kernels import point_distance, point_gradient
from flockopt.geometry.polylines import thinned
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.travel import stops_of

__all__ = ["corrected", "corrected_samples", "densified"]

#: Obstacles are inflated by this share of the drone's radius beyond the distance that must be kept.
INFLATION = 0.5

#: Moves of one point at the most: it may be pushed from one obstacle into the next.
MOST_MOVES = 24

#: How often the gaps between samples are halved where a corrected leg is still blocked.
HALVINGS = 2


@compiled_for(FLOATS_1, FREE_SPACE, types.float64)
def _worst(point: FloatArray, space: FreeSpace, inflation: float) -> tuple[float, int]:
    """How deep a point is within the deepest inflated obstacle, metres, and which that is; (0, -1) if in none."""
    depth, deepest = 0.0, -1
    for k in range(space.table.shape[0]):
        reach = space.needs[k] + inflation
        outside = False
        for axis in range(3):
            if point[axis] <= space.boxes[k, 0, axis] - reach or point[axis] >= space.boxes[k, 1, axis] + reach:
                outside = True
        if not outside:
            inside = reach - point_distance(space.table[k], point[0], point[1], point[2])
            if inside > depth:
                depth, deepest = inside, k
    return depth, deepest


@compiled_for(FLOATS_2, FREE_SPACE, types.float64)
def _push_out(points: FloatArray, space: FreeSpace, inflation: float) -> FloatArray:
    """The points (P, 3), all but the first and last moved along the distance's gradient out of what they are in."""
    result = points.copy()
    for i in range(1, points.shape[0] - 1):
        point = result[i]
        before = _worst(point, space, 0.0)[0]
        for _ in range(MOST_MOVES):
            depth, k = _worst(point, space, inflation)
            if k < 0:
                break
            gradient = point_gradient(space.table[k], point[0], point[1], point[2])
            for axis in range(3):
                moved = point[axis] + (depth + 1e-9) * gradient[axis]
                point[axis] = min(max(moved, space.lower[axis]), space.upper[axis])
        if _worst(point, space, 0.0)[0] > before:
            point[:] = points[i]
    return result


def corrected(control: FloatArray, room: Room, radius: float) -> FloatArray:
    """Control points (K, 3) with the inner ones moved out of inflated obstacles, as far as there is room."""
    return _push_out(control, room.space, INFLATION * radius)


def densified(control: FloatArray) -> FloatArray:
    """Control points (2 K - 1, 3) with the middles between neighbours added."""
    result = np.empty((2 * len(control) - 1, 3))
    result[::2] = control
    result[1::2] = (control[:-1] + control[1:]) / 2
    return result


@compiled_for(FLOATS_2, FREE_SPACE, types.float64)
def _corrected_leg(leg: FloatArray, space: FreeSpace, inflation: float) -> tuple[FloatArray, bool]:
    """A leg's samples moved out of inflated obstacles, closer ones if that is not enough; and whether it is clear."""
    moved = _push_out(leg, space, inflation)
    clear = polyline_free(space, moved)
    for _ in range(HALVINGS):
        if not clear:
            closer = np.empty((2 * len(moved) - 1, 3))
            closer[::2] = moved
            closer[1::2] = (moved[:-1] + moved[1:]) / 2
            moved = _push_out(closer, space, inflation)
            clear = polyline_free(space, moved)
    return moved, clear


def corrected_samples(scene: Scene, travel: Travel, drone: int, route: Sequence[int], samples: FloatArray) -> Waypoints:
    """Waypoints through one drone's samples (T, 3), corrected; start, tasks and end are exact anchors.

    Samples are moved out of obstacles first, and thinned as in `waypoints_from_samples` after: a law of progress that
    depends on nothing but the curve takes every little bend of many control points at speed, and pays for it. Where a
    leg through the corrected samples is blocked, the any-angle path takes its place.
    """
    raw = anchored_legs(scene, drone, route, samples)
    anchors = np.array([scene.starts[drone]] + [leg[-1] for leg in raw])
    if (anchors == anchors[0]).all():
        return waypoints_from_paths(scene, travel, drone, route)
    record = scene.drones[drone]
    stops = stops_of(scene, drone, route)
    space = scene.free_space(record.radius + scene.clearance)
    legs = []
    for leg, (origin, target) in zip(raw, pairwise(stops), strict=True):
        moved, clear = _corrected_leg(leg, space, INFLATION * record.radius)
        if clear:
            few = thinned(moved, CHORD_TOLERANCE * record.radius)
            legs.append(few if polyline_free(space, few) else moved)
        elif len(detour := travel.path(drone, origin, target)):
            legs.append(detour)
        else:
            return waypoints_from_paths(scene, travel, drone, route)  # which says that there is no way
    return Waypoints.join(scene, route, legs)
