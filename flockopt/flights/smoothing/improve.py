"""A flight improved stage by stage: what its cost is measured in, where its tasks are, and whether it still serves them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from flockopt.errors import SettingsError
from flockopt.flights import Flight
from flockopt.flights.smoothing.acceptance import Weights
from flockopt.flights.smoothing.stages import Stage, join, split, squared_jerk
from flockopt.geometry.continuous import farthest_from
from flockopt.records import checks
from flockopt.scene import Drone, Scene

__all__ = [
    "JERK_WEIGHT",
    "MISSED",
    "MOTIONLESS",
    "NOTHING_BETTER",
    "NO_TIME",
    "SMOOTHED",
    "TIME_WEIGHT",
    "TOO_HIGH",
    "check_smoothing",
    "flight_cost",
    "improved",
    "shares_of",
    "tasks_of",
]  # fmt: skip

#: Mostly time: a tenth off the duration is worth three tenths off the squared jerk's integral.
TIME_WEIGHT, JERK_WEIGHT = 0.75, 0.25

#: What may be said of a flight that is to be improved.
SMOOTHED = "smoothed"
MOTIONLESS = "unchanged: it does not move"
TOO_HIGH = "unchanged: its polynomials are of a degree above 7"
NOTHING_BETTER = "unchanged: nothing cheaper was found that keeps to every constraint"
NO_TIME = "unchanged: there was no time left for it"
MISSED = "unchanged: what was found would miss a task or its rest, or be too long for its drone"

#: Coefficients of the highest polynomials that plans hold.
MOST_TERMS = 8

#: An improved flight is at its tasks within this, metres.
ANCHOR_M = 1e-6


def check_smoothing(scene: Scene, flights: Mapping[str, Flight], weights: Weights) -> None:
    """Refuse weights and flights that nothing can be made of.

    Raises:
        SettingsError: On weights that are negative or all zero, or a drone that is not in the scene.
    """
    for name, weight in (("time_weight", weights.time), ("jerk_weight", weights.jerk)):
        checks.number(SettingsError, name, weight, least=0.0)
    if weights.time + weights.jerk == 0.0:
        raise SettingsError("time_weight", "is 0 and so is jerk_weight", "one of them must be > 0", "weigh time or jerk")
    known = {drone.id for drone in scene.drones}
    for name in flights:
        if name not in known:
            raise SettingsError(f"flights[{name!r}]", "is of a drone the scene does not have", "must name a drone", "rename it")


def shares_of(flight: Flight, weights: Weights) -> Weights:
    """Weights of seconds and of the squared jerk's integral in which the given flight costs 1."""
    jerk, total = squared_jerk(flight.curve.breakpoints, flight.curve.coefficients), weights.time + weights.jerk
    return Weights(weights.time / total / flight.curve.duration, weights.jerk / total / jerk if jerk > 0.0 else 0.0)


def flight_cost(flight: Flight, shares: Weights) -> float:
    """The weighted sum of a flight's duration and its squared jerk's integral."""
    curve = flight.curve
    return shares.time * curve.duration + shares.jerk * squared_jerk(curve.breakpoints, curve.coefficients)


def tasks_of(scene: Scene, flight: Flight) -> list[int]:
    """The tasks of a flight's visits, by index.

    Raises:
        SettingsError: If one is not in the scene.
    """
    index = {task.id: number for number, task in enumerate(scene.tasks)}
    for visit in flight.visits:
        if visit.task not in index:
            raise SettingsError(
                "visits", f"name {visit.task!r}", "must name tasks of the scene", "smooth flights of this scene"
            )
    return [index[visit.task] for visit in flight.visits]


def improved(scene: Scene, drone: Drone, flight: Flight, better: Callable[[int, Stage], Stage | None]) -> tuple[Flight, str]:
    """A flight with all moving stages replaced for which there is something better, and what became of it.

    Args:
        scene: The scene.
        drone: Who flies.
        flight: The flight as it is, which comes back where nothing is better.
        better: For a stage's place among the stages and the stage, what may take its place, or None.

    Returns:
        The flight and a status: `SMOOTHED`, or that it is unchanged and why.
    """
    if flight.curve.coefficients.shape[2] > MOST_TERMS:
        return flight, TOO_HIGH
    status, stages = MOTIONLESS, []
    for place, stage in enumerate(split(flight)):
        found = None if stage.rests else better(place, stage)
        if not stage.rests:
            status = SMOOTHED if found is not None or status == SMOOTHED else NOTHING_BETTER
        stages.append(stage if found is None else found)
    if status != SMOOTHED:
        return flight, status
    result = join(flight, stages)
    return (result, SMOOTHED) if _is_as_feasible(scene, drone, flight, result) else (flight, MISSED)


def _is_as_feasible(scene: Scene, drone: Drone, given: Flight, found: Flight) -> bool:
    """Whether a flight whose stages hold is at its tasks long enough, and no longer than its drone can fly."""
    curve = found.curve
    for visit, index in zip(found.visits, tasks_of(scene, found), strict=True):
        task = scene.tasks[index]
        away, _ = farthest_from(
            curve.breakpoints, curve.coefficients, np.array(task.position), visit.time, visit.time + task.service_time
        )
        if away > ANCHOR_M:
            return False
    return drone.max_distance is None or curve.length <= max(drone.max_distance, given.curve.length)
