"""One stage smoothed: translated to the program's units, solved, translated back, and made to hold its limits exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flockopt.flights.smoothing.acceptance import Anchors, Weights, is_acceptable, is_clear, limits_of, within_limits
from flockopt.flights.smoothing.casadi_program import STATE, STEP, Answer, StageGoal, program
from flockopt.flights.smoothing.stages import Stage
from flockopt.flights.smoothing.tangents import tangent_rows
from flockopt.geometry.distances import distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene

__all__ = ["smooth_stage"]

#: Limits on speed, acceleration and jerk are used to these shares: what passes them between the program's phases is
#: taken up by flying all of the stage slower, which costs more than turning a little wider does.
LIMIT_SHARES = np.array([0.999, 0.975, 0.98])

#: The program may take this share of the given time, so that a little is left for what its limits' phases miss.
LONGEST_SHARE = 0.995

#: Extra room kept from obstacles where the given flight has it, metres.
ROOM_RESERVE_M, ROOM_RESERVE_SHARE = 1e-3, 0.01

#: A duration stays within these multiples of the given one.
SHORTEST, LONGEST = 0.5, 2.0

#: Inequalities on a piece at the most, and how near, in the drone's unit of length (max_speed**2 / max_acceleration),
#: that from which they keep it has to be. A few are enough for most stages; the others are tried once more.
ATTEMPTS = ((16, 0.5), (48, 1.0))

#: Programs are built for multiples of this many inequalities on a piece, so that few are built.
ROWS_STEP = 4


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
    scene: Scene,
    drone: Drone,
    stage: Stage,
    places: Mapping[int, FloatArray],
    weights: Weights,
    start: Stage | None = None,
) -> tuple[Stage | None, int]:
    """A cheaper stage between the same states, no slower and within every limit, clear and past every visit.

    Args:
        scene: The scene.
        drone: Who flies.
        stage: The stage as it is.
        places: (3,) m where the flight's visits are, by their index.
        weights: Of time and jerk.
        start: Where the solver begins, in place of the stage itself: a stage of as many pieces as `Stage.without_slivers`
            leaves; others are not made use of. Where it may take the stage's place, only what is cheaper is better.

    Returns:
        The stage, or None if none was found; and how many iterations the solver took.

    Raises:
        MissingExtra: If CasADi is not installed.
        SolverFailed: If the solver crashes.
    """
    guess, iterations = stage.without_slivers(), 0
    anchors = Anchors.of(guess, places)
    if anchors is None:
        return None, 0
    begin = guess if start is None or not _is_alike(guess, start) else start
    best = begin if begin is not guess and is_acceptable(scene, drone, stage, begin, weights) else None
    for num_rows, reach in ATTEMPTS:
        answer, units = _solve(scene, drone, guess, begin, stage.seconds, anchors, weights, num_rows, reach)
        iterations += answer.iterations
        if not np.isfinite(answer.variables).all():
            continue
        found = within_limits(drone, anchors.pinned(units.stage(guess, answer.variables)))
        if is_acceptable(scene, drone, stage, found, weights):
            return (found if best is None or weights.cost(found) < weights.cost(best) else best), iterations
    return best, iterations


def _is_alike(guess: Stage, start: Stage) -> bool:
    """Whether the solver may begin with a stage: joint for joint like the guess, and finite."""
    if start.states.shape != guess.states.shape or [visit[0] for visit in start.visits] != [visit[0] for visit in guess.visits]:
        return False
    return bool(np.isfinite(start.states).all() and np.isfinite(start.durations).all() and (start.durations > 0.0).all())


def _solve(
    scene: Scene, drone: Drone, guess: Stage, begin: Stage, longest_s: float, anchors: Anchors, weights: Weights,
    num_rows: int, reach: float,
) -> tuple[Answer, _Units]:  # fmt: skip
    """The program's answer for a stage, begun elsewhere or with the stage itself, and its units."""
    speed, acceleration, jerk = limits_of(drone)
    units = _Units(speed**2 / acceleration, speed / acceleration, guess.states[0, 0])
    near = begin if begin is guess or is_clear(scene, drone, begin) else guess  # half-spaces are for where there is room
    rows, offsets = _fewest(*_half_spaces(scene, drone, near, num_rows, reach * units.length))
    task = StageGoal(
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
    given = units.variables(guess)
    lower, upper = np.full(len(given), -np.inf), np.full(len(given), np.inf)
    lower[STATE::STEP], upper[STATE::STEP] = SHORTEST * given[STATE::STEP], LONGEST * given[STATE::STEP]
    for ends in (slice(STATE), slice(-STATE, None)):
        lower[ends] = upper[ends] = given[ends]
    for joint, place in anchors.joints.items():
        if 0 < joint < len(guess.durations):
            lower[STEP * joint :][:3] = upper[STEP * joint :][:3] = (place - units.origin) / units.length
    start = given if begin is guess else np.clip(units.variables(begin), lower, upper)
    return program(*offsets.shape).solve(task, start, lower, upper), units


def _half_spaces(scene: Scene, drone: Drone, guess: Stage, num_rows: int, reach_m: float) -> tuple[FloatArray, FloatArray]:
    """What keeps the stage clear and within bounds: see `tangent_rows`."""
    need = drone.radius + scene.clearance
    gaps = distances(scene.obstacle_table, guess.control.transpose(0, 2, 1).reshape(-1, 3)).min(axis=0) - need
    space = scene.free_space(need + np.clip(0.5 * gaps, 0.0, min(ROOM_RESERVE_M, ROOM_RESERVE_SHARE * need)))
    return tangent_rows(guess.control, space, num_rows, reach_m)


def _fewest(rows: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same inequalities, the used ones first, with as few unused ones as a program's size allows."""
    used = rows.any(axis=(2, 3))  # (K, R)
    order = np.argsort(~used, axis=1, kind="stable")[:, : -(-used.sum(axis=1).max() // ROWS_STEP) * ROWS_STEP]
    return np.take_along_axis(rows, order[..., None, None], axis=1), np.take_along_axis(offsets, order, axis=1)
