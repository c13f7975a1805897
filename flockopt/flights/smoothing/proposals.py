"""Stages that somebody proposes, taken where they hold: a network's, say. No proposal makes a flight dearer or less feasible.

A proposal is past its tasks and within its limits after the least change (`Anchors.pinned`, `within_limits`), and is taken
if it is cheaper, no slower, within bounds and clear in continuous time. Where it is not, the way from the given stage to it
is gone in part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TypeAlias

import numpy as np

from flockopt.flights import Flight
from flockopt.flights.smoothing.acceptance import Anchors, Weights, is_acceptable, within_limits
from flockopt.flights.smoothing.improve import (
    JERK_WEIGHT,
    SMOOTHED,
    TIME_WEIGHT,
    check_smoothing,
    flight_cost,
    improved,
    shares_of,
    tasks_of,
)
from flockopt.flights.smoothing.stages import Stage, join, split
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene

__all__ = ["Proposed", "Proposer", "fly_proposals", "proposed_stage"]

#: How far to go from the given stage to a proposal, tried in this order until one is acceptable.
SHARES = (1.0, 0.75, 0.5, 0.25)

#: Ends of proposals are those of the given stage, but for rounding: m, m/s, m/s2.
ENDS = 1e-6

#: For moving stages without slivers and who flies them: proposals for each, like it in joints, visits and ends.
Proposer: TypeAlias = Callable[[Scene, Sequence[tuple[Drone, Stage]]], Sequence[Sequence[Stage]]]


@dataclass(frozen=True)
class Proposed:
    """What came of proposals for a flight.

    Attributes:
        flight: The flight, the given one where nothing was acceptable.
        raw: The first proposals as they are, feasible or not, for a solver to begin with; the given flight without any.
        cost_before: The cost of the given flight, which is the sum of the weights.
        cost_after: The cost of ``flight``.
        shares: For each moving stage, how much of the way to a proposal was gone; 0 where it stays.
        seconds: Spent on the flight, without the proposer.
        status: As of `flockopt.flights.smoothing.improve`.
    """

    flight: Flight
    raw: Flight
    cost_before: float
    cost_after: float
    shares: tuple[float, ...]
    seconds: float
    status: str

    @property
    def at_once(self) -> bool:
        """Whether every moving stage is a proposal as it was made."""
        return self.status == SMOOTHED and min(self.shares, default=0.0) == 1.0


def proposed_stage(
    scene: Scene,
    drone: Drone,
    stage: Stage,
    places: Mapping[int, FloatArray],
    weights: Weights,
    proposals: Sequence[Stage],
) -> tuple[Stage | None, float]:
    """The cheapest acceptable one of some proposals, or as much of the way to one as is acceptable.

    Args:
        scene: The scene.
        drone: Who flies.
        stage: The stage as it is.
        places: (3,) m where the flight's visits are, by their index.
        weights: Of time and jerk.
        proposals: Stages like ``stage.without_slivers()`` in joints, visits and ends. Ones that are not finite do not count.

    Returns:
        What may take the stage's place and how much of the way was gone, or None and 0.
    """
    guess = stage.without_slivers()
    anchors = Anchors.of(guess, places)
    if anchors is None:
        return None, 0.0
    finite = [proposal for proposal in proposals if _is_usable(guess, proposal)]
    for share in SHARES:
        parts = [within_limits(drone, anchors.pinned(_blended(guess, proposal, share, anchors))) for proposal in finite]
        for part in sorted(parts, key=weights.cost):
            if is_acceptable(scene, drone, stage, part, weights):
                return part, share
    return None, 0.0


def _is_usable(guess: Stage, proposal: Stage) -> bool:
    """Whether a proposal is finite, takes time, and has the joints and ends of the guess."""
    if proposal.states.shape != guess.states.shape or proposal.durations.shape != guess.durations.shape:
        return False
    if not (np.isfinite(proposal.states).all() and np.isfinite(proposal.durations).all()):
        return False
    same_ends = np.allclose(proposal.states[[0, -1]], guess.states[[0, -1]], rtol=0.0, atol=ENDS)
    return bool(same_ends and (proposal.durations > 0.0).all())


def _blended(guess: Stage, proposal: Stage, share: float, anchors: Anchors) -> Stage:
    """Part of the way from the guess to a proposal; joints at tasks stay."""
    states = guess.states + share * (proposal.states - guess.states)
    durations = guess.durations + share * (proposal.durations - guess.durations)
    fixed = list(anchors.joints)
    states[[0, -1]] = guess.states[[0, -1]]
    states[fixed, 0] = guess.states[fixed, 0]
    return replace(guess, states=states, durations=durations)


def fly_proposals(
    scene: Scene,
    flights: Mapping[str, Flight],
    propose: Proposer,
    *,
    time_weight: float = TIME_WEIGHT,
    jerk_weight: float = JERK_WEIGHT,
) -> dict[str, Proposed]:
    """Flights of what is proposed for their stages, asked for all at once.

    Args:
        scene: The scene.
        flights: Flights by drone id, as from `decode`.
        propose: Called once, with the moving stages of all flights.
        time_weight: Of a flight's duration, as a share of what it was.
        jerk_weight: Of the integral of the squared jerk, as a share of what it was.

    Returns:
        A report for every flight, in the terms of `flockopt.flights.smoothing.smooth.smooth_each`.

    Raises:
        SettingsError: On weights that are negative or all zero, or a drone that is not in the scene.
    """
    weights = Weights(time_weight, jerk_weight)
    check_smoothing(scene, flights, weights)
    drones = {drone.id: drone for drone in scene.drones}
    asked = [
        (name, place, stage) for name, flight in flights.items() for place, stage in enumerate(split(flight)) if not stage.rests
    ]
    answers = propose(scene, [(drones[name], stage.without_slivers()) for name, _, stage in asked]) if asked else []
    proposals: dict[str, dict[int, Sequence[Stage]]] = {name: {} for name in flights}
    for (name, place, _), answer in zip(asked, answers, strict=True):
        proposals[name][place] = answer
    return {name: _flown(scene, drones[name], flight, weights, proposals[name]) for name, flight in flights.items()}


def _flown(scene: Scene, drone: Drone, flight: Flight, weights: Weights, proposals: Mapping[int, Sequence[Stage]]) -> Proposed:
    began, before, shares = perf_counter(), weights.time + weights.jerk, shares_of(flight, weights)
    places = {index: np.array(scene.tasks[task].position) for index, task in enumerate(tasks_of(scene, flight))}
    gone: list[float] = []

    def better(place: int, stage: Stage) -> Stage | None:
        found, share = proposed_stage(scene, drone, stage, places, shares, proposals[place])
        gone.append(share)
        return found

    found, status = improved(scene, drone, flight, better)
    after = before if found is flight else before * flight_cost(found, shares)
    raw = _raw(flight, proposals)
    return Proposed(found, raw, before, after, tuple(gone), perf_counter() - began, status)


def _raw(flight: Flight, proposals: Mapping[int, Sequence[Stage]]) -> Flight:
    """The flight along the first usable proposal of every stage, whatever it breaks."""
    stages = []
    for place, stage in enumerate(split(flight)):
        guess = stage.without_slivers()
        usable = [proposal for proposal in proposals.get(place, ()) if _is_usable(guess, proposal)]
        stages.append(usable[0] if usable else stage if stage.rests else guess)
    return join(flight, stages)
