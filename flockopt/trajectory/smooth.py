"""Smoothing: flights that take less time and less jerk than the closed form's, by nonlinear programming.

Of every piece of a flight, the states at its ends and its duration are free; the cost is a weighted sum of the
flight's duration and its squared jerk's integral, each as a share of what it was. Limits, clearance, bounds, tasks and
rests are constraints, and are checked exactly afterwards: what comes out is never dearer, slower or less feasible than
what went in. Flights are smoothed one by one, so that drones may meet: `deconflict` comes after.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from flockopt import reading
from flockopt.continuous import farthest_from
from flockopt.curve import Flight
from flockopt.errors import SettingsError
from flockopt.scene import Drone, Scene
from flockopt.trajectory.smooth_program import load_casadi
from flockopt.trajectory.smooth_stage import Weights, smooth_stage
from flockopt.trajectory.stages import join, split, squared_jerk

__all__ = ["Smoothed", "smooth", "smooth_each"]

#: Mostly time: a tenth off the duration is worth three tenths off the squared jerk's integral.
TIME_WEIGHT, JERK_WEIGHT = 0.75, 0.25

#: What `Smoothed.status` may say.
SMOOTHED = "smoothed"
MOTIONLESS = "unchanged: it does not move"
TOO_HIGH = "unchanged: its polynomials are of a degree above 7"
NOTHING_BETTER = "unchanged: nothing cheaper was found that keeps to every constraint"
MISSED = "unchanged: what was found would miss a task or its rest, or be too long for its drone"

#: Coefficients of the highest polynomials that plans hold.
MOST_TERMS = 8

#: A smoothed flight is at its tasks within this, metres.
ANCHOR_M = 1e-6


@dataclass(frozen=True)
class Smoothed:
    """What smoothing made of a flight.

    Attributes:
        flight: The smoothed flight, or the given one where nothing better was found.
        cost_before: The cost of the given flight, which is the sum of the weights.
        cost_after: The cost of ``flight``, in the same measure.
        iterations: Of the solver.
        seconds: Spent on it.
        status: ``smoothed``, or ``unchanged: `` and why.
    """

    flight: Flight
    cost_before: float
    cost_after: float
    iterations: int
    seconds: float
    status: str


def smooth(
    scene: Scene,
    flights: Mapping[str, Flight],
    *,
    time_weight: float = TIME_WEIGHT,
    jerk_weight: float = JERK_WEIGHT,
    jobs: int = 1,
) -> dict[str, Flight]:
    """Smoother flights: `smooth_each` without its reports, with the same arguments and errors."""
    reports = smooth_each(scene, flights, time_weight=time_weight, jerk_weight=jerk_weight, jobs=jobs)
    return {drone: report.flight for drone, report in reports.items()}


def smooth_each(
    scene: Scene,
    flights: Mapping[str, Flight],
    *,
    time_weight: float = TIME_WEIGHT,
    jerk_weight: float = JERK_WEIGHT,
    jobs: int = 1,
) -> dict[str, Smoothed]:
    """Smooth flights and say what came of each.

    Args:
        scene: The scene.
        flights: Flights by drone id, as from `decode`.
        time_weight: Of a flight's duration, as a share of what it was.
        jerk_weight: Of the integral of the squared jerk, as a share of what it was.
        jobs: Processes; more than one pays for fleets that take seconds.

    Returns:
        A report for every flight. Where and when each begins, the places it serves and its rests stay the same, and so
        does its number of pieces or it falls; it lasts no longer and is C2.

    Raises:
        SettingsError: On weights that are negative or all zero, fewer than one job, or a drone that is not in the scene.
        MissingExtra: If CasADi is not installed.
        SolverFailed: If the solver crashes.
    """
    _check_settings(scene, flights, time_weight, jerk_weight, jobs)
    load_casadi()
    drones = {drone.id: drone for drone in scene.drones}
    weights = Weights(time_weight, jerk_weight)
    if jobs == 1:
        reports = [_smooth_one(scene, drones[name], flight, weights) for name, flight in flights.items()]
    else:
        from joblib import Parallel, delayed

        work = (delayed(_smooth_one)(scene, drones[name], flight, weights) for name, flight in flights.items())
        reports = Parallel(n_jobs=jobs)(work)
    return dict(zip(flights, reports, strict=True))


def _check_settings(scene: Scene, flights: Mapping[str, Flight], time_weight: float, jerk_weight: float, jobs: int) -> None:
    for name, weight in (("time_weight", time_weight), ("jerk_weight", jerk_weight)):
        reading.number(SettingsError, name, weight, least=0.0)
    if time_weight + jerk_weight == 0.0:
        raise SettingsError("time_weight", "is 0 and so is jerk_weight", "one of them must be > 0", "weigh time or jerk")
    reading.integer(SettingsError, "jobs", jobs, least=1)
    known = {drone.id for drone in scene.drones}
    for name in flights:
        if name not in known:
            raise SettingsError(f"flights[{name!r}]", "is of a drone the scene does not have", "must name a drone", "rename it")


def _smooth_one(scene: Scene, drone: Drone, flight: Flight, weights: Weights) -> Smoothed:
    began, before = perf_counter(), weights.time + weights.jerk  # the solver sees weights that add up to 1
    tasks, shares = _tasks(scene, flight), _shares(flight, weights)
    smoother, iterations, status = _by_stages(scene, drone, flight, tasks, shares)
    if smoother is not None and not _as_feasible(scene, drone, flight, smoother, tasks):
        smoother, status = None, MISSED
    if smoother is None:
        return Smoothed(flight, before, before, iterations, perf_counter() - began, status)
    curve = smoother.curve
    after = before * (shares.time * curve.duration + shares.jerk * squared_jerk(curve.breakpoints, curve.coefficients))
    return Smoothed(smoother, before, after, iterations, perf_counter() - began, status)


def _by_stages(scene: Scene, drone: Drone, flight: Flight, tasks: list[int], shares: Weights) -> tuple[Flight | None, int, str]:
    """The flight with all stages replaced for which something better is found, or None; iterations; status."""
    if flight.curve.coefficients.shape[2] > MOST_TERMS:
        return None, 0, TOO_HIGH
    places = {index: np.array(scene.tasks[task].position) for index, task in enumerate(tasks)}
    iterations, status, stages = 0, MOTIONLESS, []
    for stage in split(flight):
        better = None
        if not stage.rests:
            better, spent = smooth_stage(scene, drone, stage, places, shares)
            iterations += spent
            status = SMOOTHED if better is not None else NOTHING_BETTER if status == MOTIONLESS else status
        stages.append(stage if better is None else better)
    return (join(flight, stages) if status == SMOOTHED else None), iterations, status


def _shares(flight: Flight, weights: Weights) -> Weights:
    """Weights of seconds and of the squared jerk's integral in which the given flight costs 1."""
    jerk, total = squared_jerk(flight.curve.breakpoints, flight.curve.coefficients), weights.time + weights.jerk
    return Weights(weights.time / total / flight.curve.duration, weights.jerk / total / jerk if jerk > 0.0 else 0.0)


def _tasks(scene: Scene, flight: Flight) -> list[int]:
    """The tasks of a flight's visits, by index."""
    index = {task.id: number for number, task in enumerate(scene.tasks)}
    for visit in flight.visits:
        if visit.task not in index:
            raise SettingsError(
                "visits", f"name {visit.task!r}", "must name tasks of the scene", "smooth flights of this scene"
            )
    return [index[visit.task] for visit in flight.visits]


def _as_feasible(scene: Scene, drone: Drone, given: Flight, smoother: Flight, tasks: list[int]) -> bool:
    """Whether a flight whose stages hold is at its tasks long enough, and no longer than its drone can fly."""
    curve = smoother.curve
    for visit, index in zip(smoother.visits, tasks, strict=True):
        task = scene.tasks[index]
        away, _ = farthest_from(
            curve.breakpoints, curve.coefficients, np.array(task.position), visit.time, visit.time + task.service_time
        )
        if away > ANCHOR_M:
            return False
    return drone.max_distance is None or curve.length <= max(drone.max_distance, given.curve.length)
