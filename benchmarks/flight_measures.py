"""What flights are worth: margins to limits, obstacles and each other, jerk, and how exactly tasks are met."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from flockopt import Scene
from flockopt.flights import Curve, Flight
from flockopt.geometry.bernstein import control_points, largest_norm
from flockopt.geometry.continuous import least_clearance, least_separation, parked
from flockopt.records.arrays import FloatArray

__all__ = [
    "clearance_margin",
    "limit_margins",
    "makespan",
    "separation_margin",
    "squared_jerk",
    "visit_error",
]

#: How far below its true value a reported margin may lie, metres.
MARGIN_TOLERANCE_M = 1e-4


def makespan(flights: Mapping[str, Flight]) -> float:
    """When the last drone is done, seconds."""
    return max((flight.curve.end_time for flight in flights.values()), default=0.0)


def squared_jerk(curve: Curve) -> float:
    """The integral of squared jerk, m2/s5: exact, as 8 Gauss nodes are for degrees up to 15."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    spans = np.diff(curve.breakpoints)
    times = curve.breakpoints[:-1, None] + spans[:, None] * (nodes + 1) / 2
    return float((np.sum(curve(times, 3) ** 2, axis=-1) @ weights) @ spans / 2)


def limit_margins(scene: Scene, flights: Mapping[str, Flight]) -> dict[str, float]:
    """By how much each limit is kept at the worst, as a fraction of it."""
    names, worst = ("speed_margin", "acceleration_margin", "jerk_margin"), [np.inf] * 3
    for drone in scene.drones:
        if drone.id in flights:
            curve = flights[drone.id].curve
            control = control_points(curve.breakpoints, curve.coefficients, curve.coefficients.shape[2])
            for k, limit in enumerate((drone.max_speed, drone.flyable_acceleration, drone.max_jerk)):
                worst[k] = min(worst[k], 1.0 - largest_norm(curve.breakpoints, control, k + 1)[0] / limit)
    return dict(zip(names, worst, strict=True))


def clearance_margin(scene: Scene, flights: Mapping[str, Flight]) -> float:
    """How much farther from obstacles than they must the drones stay at the worst, metres."""
    margins = [np.inf]
    for drone in scene.drones:
        if drone.id in flights:
            curve, space = flights[drone.id].curve, scene.free_space(drone.radius + scene.clearance)
            margins.append(least_clearance(space, curve.breakpoints, curve.coefficients, MARGIN_TOLERANCE_M)[0])
    return min(margins)


def separation_margin(scene: Scene, flights: Mapping[str, Flight]) -> float:
    """How much farther from each other than they must the drones stay at the worst, metres; parked ones count."""
    curves: list[tuple[FloatArray, FloatArray]] = [
        (flights[drone.id].curve.breakpoints, flights[drone.id].curve.coefficients)
        if drone.id in flights
        else parked(np.array(drone.start))
        for drone in scene.drones
    ]
    worst, end = np.inf, makespan(flights)
    for i, j in combinations(range(scene.num_drones), 2):
        axes = scene.axes_between(i, j)
        worst = min(worst, least_separation(*curves[i], *curves[j], axes, 0.0, end, MARGIN_TOLERANCE_M, worst)[0])
    return float(worst)


def visit_error(scene: Scene, flights: Mapping[str, Flight]) -> float:
    """How far from its task a drone is at its visit at most, metres."""
    positions = {task.id: task.position for task in scene.tasks}
    visits = [(flight, visit) for flight in flights.values() for visit in flight.visits]
    return max((float(np.linalg.norm(flight.curve(v.time) - positions[v.task])) for flight, v in visits), default=0.0)
