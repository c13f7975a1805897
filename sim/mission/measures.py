"""What a recorded flight achieved: tasks served, room kept, and how near it stayed to its plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.flights import Curve, Flight
from flockopt.geometry.kernels import point_distance
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

__all__ = ["Measures", "measure", "worst_distance"]


@dataclass(frozen=True)
class Measures:
    """Measures of a flight.

    Attributes:
        served: Ids of the tasks that were served.
        missed: Metres, by id, that the drone was away at most from a task in its plan that it should have been serving.
        completion: Served tasks over all tasks of the scene; 1 where it has none.
        min_clearance: Least gap between a drone's body (the scene's ball) and an obstacle, metres; None without obstacles.
        min_separation: Least distance between two drones' centres, metres (scaled as the scene's ellipsoid where it has
            one); None for one drone.
        mean_tracking_error: Metres from the plan, over all drones while they fly; 0 where none does.
        max_tracking_error: Metres from the plan, over all drones and the whole time.
    """

    served: tuple[str, ...]
    missed: dict[str, float]
    completion: float
    min_clearance: float | None
    min_separation: float | None
    mean_tracking_error: float
    max_tracking_error: float


def measure(
    scene: Scene, flights: Mapping[str, Flight], times: FloatArray, positions: FloatArray, service_radius: float
) -> Measures:
    """Measure a recorded flight.

    Args:
        scene: Where it was.
        flights: What was to be flown, by drone id.
        times: (T,) s.
        positions: (T, N, 3) m; NaN where a drone is no longer there.
        service_radius: How near a drone must be to a task for the whole of its service, metres.
    """
    away = _worst_at_visits(scene, flights, times, positions)
    served = tuple(task for task, metres in away.items() if metres <= service_radius)
    missed = {task: metres for task, metres in away.items() if metres > service_radius}
    mean, worst = _tracking(scene, flights, times, positions)
    scale = scene.widest_axes / scene.widest_axes[0]
    clearance = least_clearance(scene.obstacle_table, scene.obstacle_boxes, scene.radii, np.ascontiguousarray(positions))
    separation = least_separation(np.ascontiguousarray(positions / scale))
    return Measures(
        served=served,
        missed=missed,
        completion=len(served) / scene.num_tasks if scene.num_tasks else 1.0,
        min_clearance=clearance if math.isfinite(clearance) else None,
        min_separation=separation if math.isfinite(separation) else None,
        mean_tracking_error=mean,
        max_tracking_error=worst,
    )


def _worst_at_visits(scene: Scene, flights: Mapping[str, Flight], times: FloatArray, positions: FloatArray) -> dict[str, float]:
    """How far its drone was at most from each planned task during its service, metres; at the best of several visits."""
    number, tasks = {drone.id: i for i, drone in enumerate(scene.drones)}, {task.id: task for task in scene.tasks}
    away: dict[str, float] = {}
    for drone, flight in flights.items():
        track = positions[:, number[drone]]
        for visit in flight.visits:
            if visit.task in tasks:
                task = tasks[visit.task]
                metres = worst_distance(times, track, visit.time, visit.time + task.service_time, task.position)
                away[task.id] = min(metres, away.get(task.id, math.inf))
    return away


def worst_distance(times: FloatArray, track: FloatArray, begin: float, end: float, place: tuple[float, float, float]) -> float:
    """From a place over [begin, end], at the ends between samples by interpolation; infinite where the record ends before.

    Args:
        times: (T,) s, rising.
        track: (T, 3) m.
        begin: s, within the record.
        end: s.
        place: m.
    """
    if end > times[-1]:
        return math.inf
    inside = track[(times > begin) & (times < end)]
    ends = [[np.interp(moment, times, track[:, axis]) for axis in range(3)] for moment in (begin, end)]
    return float(np.linalg.norm(np.concatenate([inside, ends]) - place, axis=1).max())


def _tracking(scene: Scene, flights: Mapping[str, Flight], times: FloatArray, positions: FloatArray) -> tuple[float, float]:
    """Mean and largest distance from the plan."""
    total, count, worst = 0.0, 0, 0.0
    for i, drone in enumerate(scene.drones):
        flight = flights.get(drone.id)
        plan = np.array(drone.start) if flight is None else flight.curve(times)
        errors = np.linalg.norm(positions[:, i] - plan, axis=1)
        worst = max(worst, float(np.nanmax(errors)))
        if flight is not None:
            flying = errors[_is_flying(flight.curve, times) & np.isfinite(errors)]
            total, count = total + float(flying.sum()), count + len(flying)
    return total / count if count else 0.0, worst


def _is_flying(curve: Curve, times: FloatArray) -> NDArray[np.bool_]:
    return (times >= curve.start_time) & (times <= curve.end_time)


@compiled_lazily()
def least_clearance(table: FloatArray, boxes: FloatArray, radii: FloatArray, positions: FloatArray) -> float:
    """Least gap between any drone's ball and any obstacle over all samples, metres; infinite without obstacles."""
    least = np.inf
    for t in range(positions.shape[0]):
        for i in range(positions.shape[1]):
            x, y, z = positions[t, i]
            for k in range(table.shape[0]):
                reach = least + radii[i]
                near_x = boxes[k, 0, 0] - reach < x < boxes[k, 1, 0] + reach
                near_y = boxes[k, 0, 1] - reach < y < boxes[k, 1, 1] + reach
                if near_x and near_y:
                    least = min(least, point_distance(table[k], x, y, z) - radii[i])
    return least


@compiled_lazily()
def least_separation(positions: FloatArray) -> float:
    """Least distance between two drones over all samples, metres; infinite for one drone."""
    least = np.inf
    for t in range(positions.shape[0]):
        for i in range(positions.shape[1]):
            for j in range(i):
                square = 0.0
                for axis in range(3):
                    square += (positions[t, i, axis] - positions[t, j, axis]) ** 2
                if square < least:  # never true of a drone that is not there
                    least = square
    return math.sqrt(least)
