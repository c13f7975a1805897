"""Other people's trajectories as a plan that can be judged: CSV files of polynomials, as Crazyswarm2 and others fly them.

A file holds one drone's pieces, a row each of 33 columns: its duration, then eight coefficients each of x, y, z and yaw. All
start at t = 0, in the scene's coordinates. Such files do not say who serves what: a task is served by the drone that is first
at it, within the judge's millimetre, for as long as its service takes. What they cost is worked out from what they fly.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from flockopt.certificate import Cost, Plan
from flockopt.certificate.clauses import VISIT_TOLERANCE_M
from flockopt.certificate.plan_file import LARGEST_DEGREE
from flockopt.errors import PlanError
from flockopt.flights import Curve, Flight, Visit
from flockopt.outputs.devices.crazyswarm2 import read_rows
from flockopt.records import files
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene import Scene, Task
from flockopt.travel import Travel

__all__ = ["load_trajectories"]

#: Between looks at a curve when visits are looked for, seconds; how much finer a visit's moment is found.
LOOK_S, FINER = 5e-3, 1000

#: A drone that comes no nearer than this between two looks is not at a task, metres.
NEAR_M = 0.5

#: Numbers with a point and no exponent: so many decimals are their precision.
DECIMALS = re.compile(r"-?\d+\.(\d+)")


def load_trajectories(scene: Scene, travel: Travel, path: str | Path) -> tuple[Plan, float]:
    """The plan that trajectories amount to, uncertified, and how far their coefficients may be off by the decimals they have.

    Args:
        scene: The scene that they are for.
        travel: Its travel, by which the plan's routes are costed.
        path: A CSV file, or a folder of them; each is named after its drone's id.

    Raises:
        PlanError: If there is none, or one cannot be read, is no such file, or names no drone of the scene.
    """
    found = sorted(Path(path).glob("*.csv")) if Path(path).is_dir() else [Path(path)]
    if not found:
        raise PlanError("", f"{path} holds no CSV file", "it must hold one for each drone that moves", "name another folder")
    known, curves, errors = {drone.id for drone in scene.drones}, {}, [0.0]
    for file in found:
        if file.stem not in known:
            raise PlanError("", f"{file} is named after no drone", "a file's name is its drone's id", "rename it")
        text = files.read_text(PlanError, file)
        try:
            curves[file.stem] = _curve(_rows(text))
        except PlanError as fault:
            raise PlanError(f"{file}: {fault.field}", fault.value, fault.rule, fault.mend) from None
        errors.append(_rounding(text))
    flights = {drone: Flight(curve, ()) for drone, curve in curves.items()}
    for task in scene.tasks:
        times = {drone: _first_visit(curve, task) for drone, curve in curves.items()}
        first = min((time, drone) for drone, time in times.items()) if times else (np.inf, "")
        if first[0] < np.inf:
            flight = flights[first[1]]
            visits = sorted((*flight.visits, Visit(task.id, first[0])), key=lambda visit: visit.time)
            flights[first[1]] = Flight(flight.curve, tuple(visits))
    return _plan(scene, travel, flights), max(errors)


def _rows(text: str) -> FloatArray:
    """(K, 33) of a file, whose header may be missing and whose lines may end with a comma."""
    lines = [line.strip().rstrip(",") for line in text.splitlines() if line.strip()]
    return read_rows(lines[1:] if lines and not re.match(r"[-+.\d]", lines[0]) else lines)


def _curve(rows: FloatArray) -> Curve:
    terms = rows[:, 1:].reshape(len(rows), 4, LARGEST_DEGREE + 1)[:, :3]
    return Curve(np.concatenate([[0.0], np.cumsum(rows[:, 0])]), terms)


def _rounding(text: str) -> float:
    """How far a coefficient may be off: half of the last decimal, where all have few; 0 where they are written in full."""
    decimals = [len(digits) for digits in DECIMALS.findall(text)]
    most = max(decimals, default=0)
    return 0.5 * 10.0**-most if decimals and most < 10 and "e" not in text.partition("\n")[2].lower() else 0.0


def _first_visit(curve: Curve, task: Task) -> float:
    """When a drone is first at a task for as long as its service takes, seconds; infinite if never."""
    place = np.array(task.position)
    looks = np.linspace(0.0, curve.end_time, 2 + int(curve.end_time / LOOK_S))
    away = np.linalg.norm(curve(looks) - place, axis=1)
    near = np.flatnonzero(np.minimum(away[:-1], away[1:]) < NEAR_M)
    for look in near:
        times = np.linspace(looks[look], looks[look + 1], FINER)
        there = np.linalg.norm(curve(times) - place, axis=1) <= VISIT_TOLERANCE_M
        if not there.any():
            continue
        begin = float(times[there.argmax()])
        if not task.service_time:
            return float(times[int(np.linalg.norm(curve(times) - place, axis=1).argmin())])
        during = np.linspace(begin, begin + task.service_time, 2 + int(task.service_time / LOOK_S))
        if (np.linalg.norm(curve(during) - place, axis=1) <= VISIT_TOLERANCE_M).all():
            return begin
    return float("inf")


def _plan(scene: Scene, travel: Travel, flights: dict[str, Flight]) -> Plan:
    number = {task.id: index for index, task in enumerate(scene.tasks)}
    routes = {drone: tuple(visit.task for visit in flight.visits) for drone, flight in flights.items()}
    indices = [[number[task] for task in routes.get(drone.id, ())] for drone in scene.drones]
    length = sum(flight.curve.length for flight in flights.values())
    makespan = max(flight.curve.end_time for flight in flights.values())
    cost = Cost(length=length, travel=travel.total(indices), lower_bound=None, gap=None, makespan=makespan)
    served = {task for route in routes.values() for task in route}
    unserved = {task.id: "no trajectory comes to it" for task in scene.tasks if task.id not in served}
    return Plan(scene.name, scene.sha256, "trajectories", Status.UNCERTIFIED, routes, unserved, flights, cost)
