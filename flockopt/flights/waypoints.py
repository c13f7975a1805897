"""Waypoints: the polyline each drone is to follow, with the tasks and rests on it.

They come from the any-angle paths behind the travel matrix, or from the samples of whoever proposes a route
(a learned planner, a person); samples are control points, tasks are exact anchors between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from flockopt.errors import SettingsError
from flockopt.flights.curve import Visit
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.travel import stops_of

__all__ = [
    "FLY_THROUGH", "Waypoints", "anchored_legs", "check_samples", "leg_clear", "waypoints_from_paths", "waypoints_from_samples",
]  # fmt: skip

#: The value of `Waypoints.rest_s` that asks for no stop.
FLY_THROUGH = -1.0

#: Points closer than this are one point, metres.
SAME_POINT_M = 1e-6

#: Samples closer than this fraction of the drone's radius to the chord between their neighbours are dropped.
CHORD_TOLERANCE = 0.3


@dataclass(frozen=True)
class Waypoints:
    """The points one drone passes, in order.

    Attributes:
        points: (n + 1, 3) m, consecutive ones apart.
        rest_s: (n + 1,) s; `FLY_THROUGH`, or how long the drone rests there.
        tasks: For each point the indices of the tasks served at it.
    """

    points: FloatArray
    rest_s: FloatArray
    tasks: tuple[tuple[int, ...], ...]

    @classmethod
    def join(cls, scene: Scene, route: Sequence[int], legs: Sequence[FloatArray]) -> Waypoints:
        """Waypoints along consecutive legs; leg r ends at task ``route[r]``, one more may lead on to the end."""
        points, rests = [legs[0][0]], [FLY_THROUGH]
        tasks: list[tuple[int, ...]] = [()]
        for index, leg in enumerate(legs):
            for point in leg[1:]:
                if math.dist(point, points[-1]) > SAME_POINT_M:
                    points.append(point)
                    rests.append(FLY_THROUGH)
                    tasks.append(())
            if index < len(route):
                service_s = scene.tasks[route[index]].service_time
                tasks[-1] = (*tasks[-1], route[index])
                if service_s > 0.0:
                    rests[-1] = max(rests[-1], 0.0) + service_s
        rests[-1] = max(rests[-1], 0.0)
        return cls(np.array(points), np.array(rests), tuple(tasks))

    @property
    def moves(self) -> bool:
        """Whether there is more than one point."""
        return len(self.points) > 1

    def visits(self, scene: Scene, times: FloatArray) -> tuple[Visit, ...]:
        """Visits to all tasks when the points are reached at ``times`` (n + 1,) s.

        Tasks at one point are served one after another; the first begins when the drone has come to a halt.
        """
        visits = []
        for tasks, time in zip(self.tasks, times, strict=True):
            begin_s = float(time)
            for task in tasks:
                visits.append(Visit(scene.tasks[task].id, begin_s))
                begin_s += scene.tasks[task].service_time
        return tuple(visits)


def waypoints_from_paths(scene: Scene, travel: Travel, drone: int, route: Sequence[int]) -> Waypoints:
    """The shortest obstacle-avoiding way through a drone's tasks in order, and on to its end if it has one.

    Raises:
        SettingsError: If there is no way between two of them.
    """
    stops = stops_of(scene, drone, route)
    if len(stops) == 1:
        return Waypoints(scene.starts[drone : drone + 1], np.zeros(1), ((),))
    legs = [travel.path(drone, *pair) for pair in pairwise(stops)]
    for index, leg in enumerate(legs):
        if not len(leg):
            rule = f"leg {index} must have a way for drone {scene.drones[drone].id!r}"
            raise SettingsError(f"bundles[{drone}]", f"is {tuple(route)}", rule, "leave unreachable tasks out")
    return Waypoints.join(scene, route, legs)


def check_samples(scene: Scene, samples: ArrayLike) -> FloatArray:
    """Samples as an (N, T, 3) array of finite positions, T >= 2.

    Raises:
        SettingsError: On another shape, or a NaN or an infinity.
    """
    array = np.asarray(samples, dtype=np.float64)
    if array.ndim != 3 or array.shape[0] != scene.num_drones or array.shape[1] < 2 or array.shape[2] != 3:
        rule = f"must be ({scene.num_drones}, T >= 2, 3): drone, sample, xyz"
        raise SettingsError("samples", f"has shape {array.shape}", rule, "give every drone its samples, metres")
    if not np.isfinite(array).all():
        drone, sample, axis = np.argwhere(~np.isfinite(array))[0]
        value = array[drone, sample, axis]
        raise SettingsError(f"samples[{drone}][{sample}][{axis}]", f"is {value}", "must be finite", "check the proposal")
    return array


def waypoints_from_samples(scene: Scene, travel: Travel, drone: int, route: Sequence[int], samples: FloatArray) -> Waypoints:
    """Waypoints along one drone's samples (T, 3), with its start, tasks and end as exact anchors.

    Where a leg through the samples is blocked, the any-angle path takes its place.
    """
    from flockopt.geometry.polylines import thinned

    detour = waypoints_from_paths(scene, travel, drone, route)
    if not detour.moves:
        return detour
    tolerance = CHORD_TOLERANCE * scene.drones[drone].radius
    legs = []
    for raw, stops in zip(anchored_legs(scene, drone, route, samples), pairwise(stops_of(scene, drone, route)), strict=True):
        leg = thinned(raw, tolerance)
        legs.append(leg if leg_clear(scene, drone, leg) else travel.path(drone, *stops))
    return Waypoints.join(scene, route, legs)


def anchored_legs(scene: Scene, drone: int, route: Sequence[int], samples: FloatArray) -> list[FloatArray]:
    """One drone's samples (T, 3) split into legs (V, 3) between its anchors: start, tasks, end if it has one.

    Each anchor takes the place of the sample nearest to it, in order.
    """
    ends = scene.ends[drone : drone + 1] if scene.drones[drone].end_point is not None else np.empty((0, 3))
    anchors = np.vstack([scene.starts[drone], scene.task_positions[list(route)], ends])
    places = _ordered_matches(anchors, samples)
    return [
        np.vstack([anchors[index], samples[places[index] + 1 : places[index + 1]], anchors[index + 1]])
        for index in range(len(anchors) - 1)
    ]


def _ordered_matches(anchors: FloatArray, samples: FloatArray) -> list[int]:
    """An increasing sample index for every anchor, least in squared distance (dynamic programming).

    The first anchor takes sample 0; the last one takes the last sample.
    """
    gaps = np.sum((anchors[:, None] - samples[None]) ** 2, axis=-1)  # (A, T)
    best, came_from = gaps[0].copy(), []
    best[1:] = np.inf
    for row in gaps[1:]:
        least = np.minimum.accumulate(best)
        came_from.append(np.maximum.accumulate(np.where(best <= least, np.arange(len(best)), 0)))
        best = least + row
    place = len(samples) - 1
    places = [place]
    for origins in reversed(came_from):
        place = int(origins[place])
        places.append(place)
    return places[::-1]


def leg_clear(scene: Scene, drone: int, leg: FloatArray) -> bool:
    """Whether a polyline (V, 3) stays within bounds and as far from all obstacles as the drone must."""
    from flockopt.geometry.free_space import polyline_free

    space = scene.free_space(scene.drones[drone].radius + scene.clearance)
    return bool(polyline_free(space, np.ascontiguousarray(leg)))
