"""Small scenes with Crazyflie-sized drones, and checks of the flights through them."""

from __future__ import annotations

import itertools

import numpy as np

from flockopt import Bounds, Bundles, Drone, Scene, Task
from flockopt.geometry.bernstein import control_points, largest_norm
from flockopt.geometry.continuous import curve_clear, least_separation, parked

BOUNDS = Bounds((0, 0, 0), (10, 10, 4))


def drone(index: int, start: tuple, capacity: int = 5, **fields) -> Drone:
    limits = {"radius": 0.12, "max_speed": 2.0, "max_acceleration": 4.0, "max_jerk": 30.0}
    return Drone(f"d{index}", start, capacity, **(limits | fields))


def make_scene(drones: list, tasks: list, obstacles: tuple = (), **fields) -> Scene:
    records = [task if isinstance(task, Task) else Task(f"t{j}", task) for j, task in enumerate(tasks)]
    return Scene("test", BOUNDS, tuple(drones), tuple(records), obstacles, clearance=0.1, separation=0.4, **fields)


def in_order(scene: Scene) -> Bundles:
    """Tasks dealt out in turn, each drone taking as many as it can."""
    routes, left = [], list(range(scene.num_tasks))
    for record in scene.drones:
        routes.append(tuple(left[: record.capacity]))
        left = left[record.capacity :]
    return Bundles(tuple(routes))


def check_flights(scene: Scene, flights: dict, limits_slack: float = 1e-9) -> None:
    for record in scene.drones:
        if record.id not in flights:
            continue
        curve = flights[record.id].curve
        blocked = curve_clear(scene.free_space(record.radius + scene.clearance), curve.breakpoints, curve.coefficients)
        assert blocked == -1
        control = control_points(curve.breakpoints, curve.coefficients, curve.coefficients.shape[2])
        limits = (record.max_speed, record.max_acceleration, record.max_jerk)
        for order, limit in enumerate(limits, start=1):
            assert largest_norm(curve.breakpoints, control, order)[0] <= limit * (1 + limits_slack)
        positions = {task.id: task.position for task in scene.tasks}
        for visit in flights[record.id].visits:
            np.testing.assert_allclose(curve(visit.time), positions[visit.task], atol=1e-9)


def worst_separation(scene: Scene, flights: dict) -> float:
    """Least margin of any pair over all time, metres."""
    curves = [
        (flights[record.id].curve.breakpoints, flights[record.id].curve.coefficients)
        if record.id in flights
        else parked(np.array(record.start))
        for record in scene.drones
    ]
    end = max(curve[0][-1] for curve in curves)
    return min(
        least_separation(*curves[i], *curves[j], scene.axes_between(i, j), 0.0, end, 1e-6, np.inf)[0]
        for i, j in itertools.combinations(range(len(curves)), 2)
    )
