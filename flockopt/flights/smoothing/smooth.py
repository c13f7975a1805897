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

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.errors import SettingsError
from flockopt.flights import Flight
from flockopt.flights.smoothing.acceptance import Weights
from flockopt.flights.smoothing.casadi_program import load_casadi
from flockopt.flights.smoothing.casadi_stage import smooth_stage
from flockopt.flights.smoothing.improve import (
    JERK_WEIGHT,
    NO_TIME,
    TIME_WEIGHT,
    check_smoothing,
    flight_cost,
    improved,
    shares_of,
    tasks_of,
)
from flockopt.flights.smoothing.stages import Stage, split
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene

__all__ = ["Smoothed", "smooth", "smooth_each"]


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
    starts: Mapping[str, Flight] | None = None,
    deadline: Deadline = NEVER,
) -> dict[str, Flight]:
    """Smoother flights: `smooth_each` without its reports, with the same arguments and errors."""
    weights = {"time_weight": time_weight, "jerk_weight": jerk_weight}
    reports = smooth_each(scene, flights, **weights, jobs=jobs, starts=starts, deadline=deadline)
    return {drone: report.flight for drone, report in reports.items()}


def smooth_each(
    scene: Scene,
    flights: Mapping[str, Flight],
    *,
    time_weight: float = TIME_WEIGHT,
    jerk_weight: float = JERK_WEIGHT,
    jobs: int = 1,
    starts: Mapping[str, Flight] | None = None,
    deadline: Deadline = NEVER,
) -> dict[str, Smoothed]:
    """Smooth flights and say what came of each.

    Args:
        scene: The scene.
        flights: Flights by drone id, as from `decode`.
        time_weight: Of a flight's duration, as a share of what it was.
        jerk_weight: Of the integral of the squared jerk, as a share of what it was.
        jobs: Processes; more than one pays for fleets that take seconds.
        starts: Flights for the solver to begin with in place of the given ones, by drone id; those of the same visits and
            pieces are made use of. One that is feasible and cheaper is what comes back unless a cheaper one is found.
        deadline: The flights that are not begun by then stay as they are.

    Returns:
        A report for every flight. Where and when each begins, the places it serves and its rests stay the same, and so
        does its number of pieces or it falls; it lasts no longer and is C2.

    Raises:
        SettingsError: On weights that are negative or all zero, fewer than one job, or a drone that is not in the scene.
        MissingExtra: If CasADi is not installed.
        SolverFailed: If the solver crashes.
    """
    weights = Weights(time_weight, jerk_weight)
    check_smoothing(scene, flights, weights)
    checks.integer(SettingsError, "jobs", jobs, least=1)
    load_casadi()
    drones, starts = {drone.id: drone for drone in scene.drones}, starts or {}
    work = [(scene, drones[name], flight, weights, starts.get(name), deadline) for name, flight in flights.items()]
    if jobs == 1:
        reports = [_smooth_one(*part) for part in work]
    else:
        from joblib import Parallel, delayed

        reports = Parallel(n_jobs=jobs)(delayed(_smooth_one)(*part) for part in work)
    return dict(zip(flights, reports, strict=True))


def _smooth_one(
    scene: Scene, drone: Drone, flight: Flight, weights: Weights, start: Flight | None, deadline: Deadline
) -> Smoothed:
    began, before = perf_counter(), weights.time + weights.jerk  # the solver sees weights that add up to 1
    if deadline.is_over:
        return Smoothed(flight, before, before, 0, 0.0, NO_TIME)
    shares = shares_of(flight, weights)
    solver = _Solver(scene, drone, flight, shares, start)
    found, status = improved(scene, drone, flight, solver)
    after = before * flight_cost(found, shares) if found is not flight else before
    return Smoothed(found, before, after, solver.iterations, perf_counter() - began, status)


class _Solver:
    """Smooths the stages of a flight, and counts iterations."""

    def __init__(self, scene: Scene, drone: Drone, flight: Flight, shares: Weights, start: Flight | None) -> None:
        self.scene, self.drone, self.shares, self.iterations = scene, drone, shares, 0
        self._places: dict[int, FloatArray] = {
            index: np.array(scene.tasks[task].position) for index, task in enumerate(tasks_of(scene, flight))
        }
        self._starts: list[Stage] = [] if start is None else split(start)

    def __call__(self, place: int, stage: Stage) -> Stage | None:
        """What may take the place of a stage, or None."""
        start = self._starts[place] if place < len(self._starts) else None
        found, spent = smooth_stage(self.scene, self.drone, stage, self._places, self.shares, start)
        self.iterations += spent
        return found
