"""Flying a polyline by jerk-limited profiles from ruckig, faster between corners than around them.

Along each leg the speed goes from that of one corner to that of the next by the fastest state-to-state profile there
is (Berscheid and Kroeger, "Jerk-limited real-time trajectory generation with arbitrary target states", 2021), one
degree of freedom along the leg, chained with non-zero velocities. Around a corner the velocity turns at the speed
that `flockopt.flights.laws.corner_speeds` allows, along a ramp that is a profile in velocity. All pieces are cubics.
Ruckig's intermediate positions are not used: they would be computed by a server elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SolverFailed, require
from flockopt.flights.laws import fly_through
from flockopt.flights.laws.corner_speeds import SHORTEST_PHASE_S, corner_speeds, must_be_simple, peak_speed, ramp_seconds
from flockopt.flights.room import MOST_PIECES
from flockopt.records.arrays import FloatArray

__all__ = ["fly_polyline"]

#: Coefficients of a piece: cubics, and quartics where a ramp is one piece.
TERMS = 5

#: Speeds nearer to each other than this, m/s, are changed over a whole leg, and none is topped by less than this.
SMALL_CHANGE = 1e-3

#: Seconds and metres that are rounding.
NOTHING = 1e-9

Phase = tuple[float, FloatArray]  # seconds, (5,) coefficients of the way along a line


class _Profiles:
    """Ruckig for one degree of freedom.

    Raises:
        MissingExtra: If ruckig is not installed.
    """

    def __init__(self, limits: FloatArray) -> None:
        ruckig = require("ruckig", extra="trajectory")
        self.limits = limits
        self._interface = ruckig.ControlInterface
        self._solver, self._trajectory = ruckig.Ruckig(1), ruckig.Trajectory(1)
        self._input = ruckig.InputParameter(1)
        self._input.max_velocity, self._input.max_acceleration, self._input.max_jerk = ([limit] for limit in limits.tolist())
        self._found = (ruckig.Result.Working, ruckig.Result.Finished)

    def straight(self, start: float, end: float, distance: float, simple: bool) -> list[Phase]:
        """The fastest way from speed ``start`` to speed ``end`` over a distance, but for phases too short to fly."""
        whole_s = 2 * distance / (start + end) if start + end > 0.0 else np.inf
        small = abs(start - end) < SMALL_CHANGE and min(start, end) > self.limits[0] - SMALL_CHANGE
        if small and whole_s >= ramp_seconds(abs(start - end), self.limits[1], self.limits[2], True):
            return [_simple_ramp(start, end, whole_s)]
        if not simple:
            request, highest = self._input, max(start, end)
            request.control_interface = self._interface.Position
            request.max_velocity = [highest if highest > self.limits[0] - SMALL_CHANGE else self.limits[0]]
            request.current_position, request.target_position = [0.0], [distance]
            request.current_velocity, request.target_velocity = [start], [end]
            phases = self._phases(start)
            if min(seconds for seconds, _ in phases) >= SHORTEST_PHASE_S:
                return phases
        return _simple_straight(start, end, distance, self.limits)

    def ramp(self, change: float, simple: bool) -> list[Phase]:
        """The fastest change of velocity from 0 to ``change``."""
        if simple or must_be_simple(change, self.limits[1], self.limits[2]):
            return [_simple_ramp(0.0, change, ramp_seconds(change, self.limits[1], self.limits[2], True))]
        request = self._input
        request.control_interface = self._interface.Velocity
        request.current_velocity, request.target_velocity = [0.0], [change]
        return self._phases(0.0)

    def _phases(self, speed: float) -> list[Phase]:
        result = self._solver.calculate(self._input, self._trajectory)
        if result not in self._found:
            raise SolverFailed("ruckig", str(result))
        profile = self._trajectory.profiles[0][0]
        phases, acceleration = [], 0.0
        for seconds, jerk in zip(profile.t, profile.j, strict=True):
            if seconds > NOTHING:
                phases.append((seconds, np.array([0.0, speed, acceleration / 2, jerk / 6, 0.0])))
            speed += seconds * (acceleration + seconds * jerk / 2)
            acceleration += seconds * jerk
        return phases


def _simple_ramp(start: float, end: float, seconds: float) -> Phase:
    """One piece from speed to speed, without acceleration at its ends."""
    change = end - start
    return seconds, np.array([0.0, start, 0.0, change / seconds**2, -change / (2 * seconds**3)])


def _simple_straight(start: float, end: float, distance: float, limits: FloatArray) -> list[Phase]:
    """At most three pieces from speed to speed over a distance: up, on, down."""
    highest = max(start, end)
    peak = float(peak_speed(start, end, distance, limits))
    if peak - highest < SMALL_CHANGE and highest > 0.0:
        peak = highest
    up, down = (ramp_seconds(peak - low, limits[1], limits[2], True) if peak - low > NOTHING else 0.0 for low in (start, end))
    flown = up * (start + peak) / 2 + down * (end + peak) / 2
    on = (distance - flown) / peak
    if on < SHORTEST_PHASE_S and flown > 0.0:
        # Ramps that take a little longer leave no gap between them.
        up, down, on = up * distance / flown, down * distance / flown, 0.0
    phases = [_simple_ramp(start, peak, up)] if up > 0.0 else []
    phases += [_simple_ramp(peak, peak, on)] if on > 0.0 else []
    return phases + ([_simple_ramp(peak, end, down)] if down > 0.0 else [])


@dataclass
class _Pieces:
    """Polynomial pieces one after another, each beginning where the one before it ends."""

    place: FloatArray  # (3,) m, where the last one ends
    durations: list[float] = field(default_factory=list)
    coefficients: list[FloatArray] = field(default_factory=list)  # (3, 5) each
    owners: list[int] = field(default_factory=list)
    clock: float = 0.0

    def add(self, phases: list[Phase], along: FloatArray, drift: FloatArray, owner: int) -> None:
        """Phases along a line (3,), on top of a constant velocity (3,)."""
        for seconds, way in phases:
            piece = along[:, None] * way
            piece[:, 0] = self.place
            piece[:, 1] += drift
            self.place = piece @ seconds ** np.arange(TERMS)
            self.durations.append(seconds)
            self.coefficients.append(piece)
            self.owners.append(owner)
            self.clock += seconds

    def rest(self, seconds: float, owner: int) -> None:
        """Holding still."""
        self.add([(seconds, np.zeros(TERMS))], np.zeros(3), np.zeros(3), owner)


def _fly_stage(
    pieces: _Pieces, points: FloatArray, caps: FloatArray, limits: FloatArray, profiles: _Profiles,
    simple: NDArray[np.bool_], first: int,
) -> FloatArray:  # fmt: skip
    """Add the pieces of a way that begins and ends at rest; the time at each of its points (n + 1,) s.

    ``simple`` (2 n + 1,) says for corner k at 2 k and for the leg after it at 2 k + 1 whether few pieces are wanted.
    """
    vertices, speeds = corner_speeds(points, caps, limits, simple[::2].copy())
    directions = np.diff(vertices, axis=0)
    lengths = np.linalg.norm(directions, axis=1)
    directions /= lengths[:, None]
    times, reach = np.full(len(points), pieces.clock), 0.0
    for k in range(len(lengths)):
        corner, speed = k + 1, float(speeds[k + 1])
        turn = speed * (directions[corner] - directions[k]) if corner < len(lengths) else np.zeros(3)
        change = float(np.linalg.norm(turn))
        phases: list[Phase] = []
        if change > NOTHING:
            phases = profiles.ramp(change, bool(simple[2 * corner]))
        seconds = sum(duration for duration, _ in phases)
        distance = float(lengths[k]) - reach - speed * seconds / 2
        way = profiles.straight(float(speeds[k]), speed, distance, bool(simple[2 * k + 1]))
        pieces.add(way, directions[k], np.zeros(3), 2 * (first + k) + 1)
        times[corner] = pieces.clock + seconds / 2
        pieces.add(phases, turn / max(change, NOTHING), speed * directions[k], 2 * (first + corner))
        reach = speed * seconds / 2
    return times


def fly_polyline(
    points: FloatArray,
    rest_s: FloatArray,
    caps: FloatArray,
    limits: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    unwanted: int = 0,
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]:
    """A C2 flight through every point of a polyline, as of `flockopt.flights.laws.fly_through.fly_polyline`.

    ``caps`` bound the speed around corners only: a corner's by the higher one of its two legs. A flight that starts
    in motion is flown by `flockopt.flights.laws.fly_through`. Where there are more than `MOST_PIECES` pieces, or by
    ``unwanted`` less, corners and then legs get simple ramps until there are not, or all have. The points are passed
    to within rounding, 1e-8 m.

    Raises:
        MissingExtra: If ruckig is not installed.
        SolverFailed: If ruckig finds no profile.
    """
    profiles = _Profiles(limits)
    if velocity.any() or acceleration.any():
        return fly_through.fly_polyline(points, rest_s, caps, limits, velocity, acceleration, unwanted)
    simple = np.zeros(2 * len(points) - 1, dtype=np.bool_)
    pieces, times = _fly_stages(points, rest_s, caps, limits, profiles, simple)
    goal = MOST_PIECES - unwanted
    while len(pieces.durations) > goal and not simple.all():
        _simplify(simple, np.array(pieces.owners), len(pieces.durations) - goal)
        pieces, times = _fly_stages(points, rest_s, caps, limits, profiles, simple)
    breakpoints = np.concatenate([[0.0], np.cumsum(pieces.durations)])
    return breakpoints, np.array(pieces.coefficients), times, np.array(pieces.owners)


def _simplify(simple: NDArray[np.bool_], owners: NDArray[np.int64], excess: int) -> None:
    """Mark as many more corners, then legs, as simple as will save ``excess`` pieces; at least one."""
    counts = np.bincount(owners, minlength=len(simple))
    savings = counts - np.where(np.arange(len(simple)) % 2 == 0, 1, 3)
    # Corners lose next to no time; of legs those that save most come first.
    order = sorted(np.flatnonzero(~simple), key=lambda element: (element % 2, -savings[element]))
    saved = 0
    for element in order:
        simple[element] = True
        saved += max(int(savings[element]), 0)
        if saved >= excess:
            break


def _fly_stages(
    points: FloatArray, rest_s: FloatArray, caps: FloatArray, limits: FloatArray, profiles: _Profiles, simple: NDArray[np.bool_]
) -> tuple[_Pieces, FloatArray]:
    """Stage after stage from stop to stop, with the rests between them."""
    pieces, times = _Pieces(points[0]), np.zeros(len(points))
    corner_caps = np.maximum(np.append(caps[:1], caps), np.append(caps, caps[-1:]))  # (n + 1,)
    first = 0
    for last in range(1, len(points)):
        if rest_s[last] < 0.0 and last < len(points) - 1:
            continue
        stage = slice(first, last + 1)
        here = simple[2 * first : 2 * last + 1]
        reached = _fly_stage(pieces, points[stage], corner_caps[stage], limits, profiles, here, first)
        times[first + 1 : last + 1] = reached[1:]
        if rest_s[last] > 0.0:
            pieces.rest(float(rest_s[last]), 2 * last)
        first = last
    return pieces, times
