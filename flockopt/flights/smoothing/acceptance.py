"""What may take the place of a stage: between the same states, past the same tasks, cheaper, no slower, as feasible."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flockopt.flights.smoothing.stages import TERMS, Stage
from flockopt.geometry.bernstein import control_points, largest_norm, least_margin
from flockopt.geometry.continuous import curve_clear
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene

__all__ = ["JOINT_PHASE", "Anchors", "Weights", "is_acceptable", "is_clear", "limits_of", "within_limits"]

#: The cost must fall by this share for a stage to be replaced.
LEAST_GAIN = 1e-6

#: A curve that leaves the bounds by no more than this does so by rounding alone, metres.
GRAZING_M = 1e-9

#: Visits at phases this near to a piece's end are at the joint.
JOINT_PHASE = 1e-6


@dataclass(frozen=True)
class Weights:
    """Cost of a stage: seconds and the integral of the squared jerk, each with its weight."""

    time: float
    jerk: float

    def cost(self, stage: Stage) -> float:
        """The weighted sum."""
        return self.time * stage.seconds + self.jerk * stage.squared_jerk


@dataclass(frozen=True)
class Anchors:
    """Where a stage passes tasks: inside of pieces, by weights of the control points, and at joints."""

    passing: FloatArray  # (K, 6), zero for none
    places: FloatArray  # (K, 3) m
    joints: dict[int, FloatArray]  # (3,) m each

    @classmethod
    def of(cls, stage: Stage, places: Mapping[int, FloatArray]) -> Anchors | None:
        """The anchors of a stage whose visits are at ``places``; None if a piece would pass two inside."""
        passing, targets, joints = np.zeros((len(stage.durations), TERMS)), np.zeros((len(stage.durations), 3)), {}
        for piece, phase, index in stage.visits:
            if min(phase, 1.0 - phase) <= JOINT_PHASE:
                joints[piece + round(phase)] = places[index]
                continue
            weights = [math.comb(5, i) * phase**i * (1.0 - phase) ** (5 - i) for i in range(TERMS)]
            if passing[piece].any() and not np.allclose(passing[piece], weights):
                return None
            passing[piece], targets[piece] = weights, places[index]
        return cls(passing, targets, joints)

    def pinned(self, stage: Stage) -> Stage:
        """The stage with its joints moved by the little that the solver's tolerance leaves between it and its anchors."""
        pieces = np.flatnonzero(self.passing.any(axis=1))
        free = [joint for joint in range(1, len(stage.durations)) if joint not in self.joints]
        if not len(pieces) or not free:
            return stage
        shares = np.zeros((len(pieces), len(stage.states)))  # of the joints' positions in where a piece passes
        shares[range(len(pieces)), pieces] = self.passing[pieces, :3].sum(axis=1)
        shares[range(len(pieces)), pieces + 1] = self.passing[pieces, 3:].sum(axis=1)
        missed = self.places[pieces] - np.einsum("kai,ki->ka", stage.control[pieces], self.passing[pieces])
        states = stage.states.copy()
        states[free, 0] += np.linalg.lstsq(shares[:, free], missed, rcond=None)[0]
        return replace(stage, states=states)


def limits_of(drone: Drone) -> tuple[float, float, float]:
    """The greatest speed, acceleration and jerk, m/s, m/s2 and m/s3."""
    return drone.max_speed, drone.flyable_acceleration, drone.max_jerk


def within_limits(drone: Drone, stage: Stage) -> Stage:
    """The stage flown as much slower as its limits ask for, exactly, if it begins at rest."""
    if not stage.starts_at_rest:
        return stage
    factor = 1.0
    for order, limit in enumerate(limits_of(drone), start=1):
        value, _ = largest_norm(stage.breakpoints, stage.control, order)
        factor = max(factor, (value / (limit * (1.0 - 1e-9))) ** (1.0 / order))
    return stage.slowed(factor)


def is_acceptable(scene: Scene, drone: Drone, given: Stage, found: Stage, weights: Weights) -> bool:
    """Whether a stage may take the place of the given one: cheaper, no slower, within limits and bounds, and clear."""
    if not (weights.cost(found) < weights.cost(given) * (1.0 - LEAST_GAIN) and found.seconds <= given.seconds):
        return False
    before = control_points(given.breakpoints, given.coefficients, given.coefficients.shape[2])
    for order, limit in enumerate(limits_of(drone), start=1):
        allowed = max(limit, largest_norm(given.breakpoints, before, order)[0])
        if largest_norm(found.breakpoints, found.control, order)[0] > allowed:
            return False
    return is_clear(scene, drone, found)


def is_clear(scene: Scene, drone: Drone, stage: Stage) -> bool:
    """Whether a stage stays within bounds and clear of every obstacle, in continuous time."""
    space = scene.free_space(drone.radius + scene.clearance)
    if least_margin(stage.breakpoints, stage.control, space.lower, space.upper)[0] < -GRAZING_M:
        return False
    return curve_clear(space, stage.breakpoints, stage.coefficients) < 0
