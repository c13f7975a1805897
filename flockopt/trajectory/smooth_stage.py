"""One stage smoothed: translated to the program's units, solved, translated back, and made to hold its limits exactly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flockopt.bernstein import control_points, largest_norm, least_margin
from flockopt.continuous import curve_clear
from flockopt.geometry import FloatArray, distances
from flockopt.scene import Drone, Scene
from flockopt.trajectory.smooth_program import STATE, STEP, Answer, Task, program
from flockopt.trajectory.stages import TERMS, Stage
from flockopt.trajectory.tangents import tangent_rows

__all__ = ["Weights", "smooth_stage"]

#: Limits on speed, acceleration and jerk are used to these shares: what passes them between the program's phases is
#: taken up by flying all of the stage slower, which costs more than turning a little wider does.
LIMIT_SHARES = np.array([0.999, 0.975, 0.98])

#: The program may take this share of the given time, so that a little is left for what its limits' phases miss.
LONGEST_SHARE = 0.995

#: Extra room kept from obstacles where the given flight has it, metres.
ROOM_RESERVE_M = 1e-3

#: A duration stays within these multiples of the given one.
SHORTEST, LONGEST = 0.5, 2.0

#: Inequalities on a piece at the most, and how near, in the drone's unit of length (max_speed**2 / max_acceleration),
#: that from which they keep it has to be. A few are enough for most stages; the others are tried once more.
ATTEMPTS = ((16, 0.5), (48, 1.0))

#: Programs are built for multiples of this many inequalities on a piece, so that few are built.
ROWS_STEP = 4

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
class _Anchors:
    """Where a stage passes tasks: inside of pieces, by weights of the control points, and at joints."""

    passing: FloatArray  # (K, 6), zero for none
    places: FloatArray  # (K, 3) m
    joints: dict[int, FloatArray]  # (3,) m each

    @classmethod
    def of(cls, stage: Stage, places: Mapping[int, FloatArray]) -> _Anchors | None:
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


@dataclass(frozen=True)
class _Units:
    """A drone's own units of length and time, about an origin."""

    length: float
    time: float
    origin: FloatArray

    def variables(self, stage: Stage) -> FloatArray:
        """A stage as the program's variables."""
        states = stage.states.copy()
        states[:, 0] -= self.origin
        result = np.empty(STEP * len(stage.durations) + STATE)
        result[STATE::STEP] = stage.durations / self.time
        blocks = np.lib.stride_tricks.sliding_window_view(result, STATE, writeable=True)[::STEP]
        blocks[:] = (states / self._of_states()).reshape(-1, STATE)
        return result

    def stage(self, like: Stage, variables: FloatArray) -> Stage:
        """The program's variables as a stage between the ends of another."""
        states = np.lib.stride_tricks.sliding_window_view(variables, STATE)[::STEP].reshape(-1, 3, 3) * self._of_states()
        states[:, 0] += self.origin
        states[[0, -1]] = like.states[[0, -1]]
        return replace(like, durations=variables[STATE::STEP] * self.time, states=states)

    def _of_states(self) -> FloatArray:
        return np.array([[self.length], [self.length / self.time], [self.length / self.time**2]])


def smooth_stage(
    scene: Scene, drone: Drone, stage: Stage, places: Mapping[int, FloatArray], weights: Weights
) -> tuple[Stage | None, int]:
    """A cheaper stage between the same states, no slower and within every limit, clear and past every visit.

    Args:
        scene: The scene.
        drone: Who flies.
        stage: The stage as it is.
        places: (3,) m where the flight's visits are, by their index.
        weights: Of time and jerk.

    Returns:
        The stage, or None if none was found; and how many iterations the solver took.

    Raises:
        MissingExtra: If CasADi is not installed.
        SolverFailed: If the solver crashes.
    """
    guess, iterations = stage.without_slivers(), 0
    anchors = _Anchors.of(guess, places)
    if anchors is None:
        return None, 0
    for num_rows, reach in ATTEMPTS:
        answer, units = _solve(scene, drone, guess, stage.seconds, anchors, weights, num_rows, reach)
        iterations += answer.iterations
        if not np.isfinite(answer.variables).all():
            continue
        found = _within_limits(drone, anchors.pinned(units.stage(guess, answer.variables)))
        if _acceptable(scene, drone, stage, found, weights):
            return found, iterations
    return None, iterations


def _solve(
    scene: Scene, drone: Drone, guess: Stage, longest_s: float, anchors: _Anchors, weights: Weights, num_rows: int, reach: float
) -> tuple[Answer, _Units]:
    """The program's answer for a stage, and its units."""
    speed, acceleration, jerk = _limits(drone)
    units = _Units(speed**2 / acceleration, speed / acceleration, guess.states[0, 0])
    rows, offsets = _fewest(*_half_spaces(scene, drone, guess, num_rows, reach * units.length))
    task = Task(
        time_weight=weights.time * units.time,
        jerk_weight=weights.jerk * units.length**2 / units.time**5,
        tightness=LIMIT_SHARES,
        max_jerk=jerk * units.time / acceleration,
        longest=LONGEST_SHARE * longest_s / units.time,
        passing=anchors.passing,
        places=(anchors.places - units.origin) / units.length,
        rows=rows,
        offsets=(offsets - rows.sum(axis=3) @ units.origin) / units.length,
    )
    start = units.variables(guess)
    lower, upper = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    lower[STATE::STEP], upper[STATE::STEP] = SHORTEST * start[STATE::STEP], LONGEST * start[STATE::STEP]
    for ends in (slice(STATE), slice(-STATE, None)):
        lower[ends] = upper[ends] = start[ends]
    for joint, place in anchors.joints.items():
        if 0 < joint < len(guess.durations):
            lower[STEP * joint :][:3] = upper[STEP * joint :][:3] = (place - units.origin) / units.length
    return program(*offsets.shape).solve(task, start, lower, upper), units


def _limits(drone: Drone) -> tuple[float, float, float]:
    return drone.max_speed, drone.flyable_acceleration, drone.max_jerk


def _half_spaces(scene: Scene, drone: Drone, guess: Stage, num_rows: int, reach_m: float) -> tuple[FloatArray, FloatArray]:
    """What keeps the stage clear and within bounds: see `tangent_rows`."""
    table, need = scene.obstacle_table, drone.radius + scene.clearance
    gaps = distances(table, guess.control.transpose(0, 2, 1).reshape(-1, 3)).min(axis=0) - need
    needs = need + np.clip(0.5 * gaps, 0.0, ROOM_RESERVE_M)
    bounds = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    return tangent_rows(guess.control, table, scene.obstacle_boxes, needs, *bounds, num_rows, reach_m)


def _fewest(rows: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same inequalities, the used ones first, with as few unused ones as a program's size allows."""
    used = rows.any(axis=(2, 3))  # (K, R)
    order = np.argsort(~used, axis=1, kind="stable")[:, : -(-used.sum(axis=1).max() // ROWS_STEP) * ROWS_STEP]
    return np.take_along_axis(rows, order[..., None, None], axis=1), np.take_along_axis(offsets, order, axis=1)


def _within_limits(drone: Drone, stage: Stage) -> Stage:
    """The stage flown as much slower as its limits ask for, exactly, if it begins at rest."""
    if not stage.starts_at_rest:
        return stage
    factor = 1.0
    for order, limit in enumerate(_limits(drone), start=1):
        value, _ = largest_norm(stage.breakpoints, stage.control, order)
        factor = max(factor, (value / (limit * (1.0 - 1e-9))) ** (1.0 / order))
    return stage.slowed(factor)


def _acceptable(scene: Scene, drone: Drone, given: Stage, found: Stage, weights: Weights) -> bool:
    """Whether a stage may take the place of the given one: cheaper, no slower, within limits and bounds, and clear."""
    if not (weights.cost(found) < weights.cost(given) * (1.0 - LEAST_GAIN) and found.seconds <= given.seconds):
        return False
    before = control_points(given.breakpoints, given.coefficients, given.coefficients.shape[2])
    for order, limit in enumerate(_limits(drone), start=1):
        allowed = max(limit, largest_norm(given.breakpoints, before, order)[0])
        if largest_norm(found.breakpoints, found.control, order)[0] > allowed:
            return False
    bounds = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    if least_margin(found.breakpoints, found.control, *bounds)[0] < -GRAZING_M:
        return False
    needs = np.full(len(scene.obstacle_table), drone.radius + scene.clearance)
    return curve_clear(scene.obstacle_table, scene.obstacle_boxes, needs, found.breakpoints, found.coefficients) < 0
