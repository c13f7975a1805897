"""Trials: a flight of given waypoints by some law, and how to mend one that is not clear.

A law flies a polyline and says which corner or leg each piece belongs to; what mends a flight is the same for all of
them: slower legs swing less, and a drone that stops at a waypoint does not swing at all, so that the worst case is
the polyline itself, which is clear.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from flockopt.flights import Curve, Flight
from flockopt.flights.laws.corners import merged_corners
from flockopt.flights.laws.fly_through import first_outside
from flockopt.flights.room import MOST_PIECES, Room
from flockopt.flights.waypoints import FLY_THROUGH, Waypoints
from flockopt.geometry.bernstein import control_points, largest_norm
from flockopt.geometry.continuous import curve_clear
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

__all__ = ["PolylineLaw", "Trial", "first_trial", "halting_ways", "mend_faults", "merge_close_corners", "save_pieces"]

#: Arguments and result as of `flockopt.flights.laws.fly_through.fly_polyline`.
PolylineLaw: TypeAlias = Callable[
    [FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, int],
    tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]],
]

#: Slower legs tried beside a fault, as shares of the speed they had, before stopping is considered.
SLOWER_SHARES = (0.7, 0.45)

#: Speeds tried on the first leg of a drone that starts in motion, as shares of its limit.
ENTRY_SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)

#: Halts ahead of a drone that can enter its way in no other manner, as shares of the way it needs to brake.
HALT_SHARES = (1.0, 1.15, 1.4, 1.8, 2.5)

#: By how much the entry from a moving start may pass the limits as they are used: half of what is held in reserve.
ENTRY_TOLERANCE = 5e-4

#: Share of the limits that flights from a moving start are planned for: no time scaling takes up what is left of them.
MOVING_SHARE = 0.98


@dataclass(frozen=True)
class Trial:
    """A flight of given waypoints at given speeds, and where it first leaves the free space."""

    waypoints: Waypoints
    room: Room
    law: PolylineLaw
    caps: FloatArray  # (n,) m/s on each leg
    breakpoints: FloatArray  # (P + 1,) s
    coefficients: FloatArray  # (P, 3, D)
    times: FloatArray  # (n + 1,) s at each waypoint
    fault: int  # owner of the first piece that is not clear (2 k: around point k, 2 k + 1: the leg after it), or -1

    @classmethod
    def make(
        cls, waypoints: Waypoints, room: Room, law: PolylineLaw, caps: FloatArray | None = None, unwanted: int = 0
    ) -> Trial:
        """A first trial, at the limits' speed unless ``caps`` say otherwise."""
        limits = room.limits * MOVING_SHARE if room.in_motion else room.limits
        if caps is None:
            caps = np.full(len(waypoints.points) - 1, limits[0])
        breakpoints, coefficients, times, owners = law(
            waypoints.points, waypoints.rest_s, caps, limits, room.velocity, room.acceleration, unwanted
        )
        blocked = curve_clear(room.space, breakpoints, coefficients)
        outside = first_outside(room.space, breakpoints, coefficients)
        faults = [int(owners[piece]) for piece in (blocked, outside) if piece >= 0]
        return cls(waypoints, room, law, caps, breakpoints, coefficients, times, min(faults, default=-1))

    def again(self, waypoints: Waypoints, caps: FloatArray | None = None, unwanted: int = 0) -> Trial:
        """Another trial by the same law."""
        return Trial.make(waypoints, self.room, self.law, caps, unwanted)

    def stopping(self) -> Trial:
        """The trial with a stop at every waypoint: the polyline itself."""
        return self.again(replace(self.waypoints, rest_s=np.maximum(self.waypoints.rest_s, 0.0)))

    @property
    def seconds(self) -> float:
        """How long the flight takes."""
        return float(self.breakpoints[-1])

    @property
    def is_flyable(self) -> bool:
        """Whether the limits are kept and every piece is clear."""
        return self.fault < 0 and self.enters()

    def enters(self) -> bool:
        """Whether the limits are kept, which a moving start may make impossible."""
        control = control_points(self.breakpoints, self.coefficients, self.coefficients.shape[2])
        norms = [largest_norm(self.breakpoints, control, order)[0] for order in (1, 2, 3)]
        return bool((norms <= self.room.limits * (1.0 + ENTRY_TOLERANCE)).all())

    def flight(self, scene: Scene) -> Flight:
        """The flight with its visits."""
        return Flight(Curve(self.breakpoints, self.coefficients), self.waypoints.visits(scene, self.times))

    def alternatives(self) -> Iterator[tuple[Waypoints, FloatArray]]:
        """Ways to swing less at the fault: slower legs beside it, or a stop at the points beside it."""
        last = len(self.waypoints.points) - 1
        points = {self.fault // 2, (self.fault + 1) // 2}
        inner = [point for point in sorted(points) if 0 < point < last and self.waypoints.rest_s[point] < 0.0]
        legs = sorted({leg for point in points for leg in (point - 1, point) if 0 <= leg < last})
        for share in SLOWER_SHARES:
            caps = self.caps.copy()
            caps[legs] *= share
            yield self.waypoints, caps
        for stops in [[point] for point in inner] + ([inner] if len(inner) > 1 else []):
            rest_s = self.waypoints.rest_s.copy()
            rest_s[stops] = 0.0
            yield replace(self.waypoints, rest_s=rest_s), self.caps


def first_trial(waypoints: Waypoints, room: Room, law: PolylineLaw) -> Trial:
    """The first trial; of a drone that starts in motion, at the highest speed of its first leg that it can enter."""
    trial = Trial.make(waypoints, room, law)
    if not room.in_motion:
        return trial
    for share in ENTRY_SHARES:
        slower = trial.again(waypoints, np.concatenate([trial.caps[:1] * share, trial.caps[1:]]))
        if slower.enters():
            return slower
    return trial


def halting_ways(waypoints: Waypoints, room: Room, returns: bool) -> Iterator[Waypoints]:
    """The way of a drone in motion with a halt straight ahead before it turns to anything else, farther ahead each time.

    Args:
        waypoints: The way; a single point where the drone goes nowhere.
        room: The drone's.
        returns: Whether a drone that goes nowhere is to be back where it started, or to stay where it halts.
    """
    _, most_acceleration, most_jerk = MOVING_SHARE * room.limits
    fading_s = float(np.linalg.norm(room.acceleration)) / most_jerk  # until the acceleration is gone, at the largest jerk
    velocity = room.velocity + 0.5 * fading_s * room.acceleration
    speed = float(np.linalg.norm(velocity))
    braking_s = max(1.5 * speed / most_acceleration, np.sqrt(6.0 * speed / most_jerk))
    ahead = (fading_s + 0.5 * braking_s) * velocity + fading_s**2 / 3.0 * room.acceleration
    start = waypoints.points[:1]
    after = slice(1 if waypoints.moves or not returns else 0, None)
    rests, tasks = np.maximum(waypoints.rest_s[after], -1.0 if waypoints.moves else 0.0), waypoints.tasks[after]
    for share in HALT_SHARES:
        points = np.concatenate([start, start + share * ahead, waypoints.points[after]])
        yield Waypoints(points, np.concatenate([[FLY_THROUGH, 0.0], rests]), ((), (), *tasks))


def merge_close_corners(trial: Trial) -> Trial:
    """The trial with close corners merged as long as that saves time, or pieces of which there are too many."""
    while True:
        ways = merged_corners(trial.waypoints, trial.room.space)
        best = min((trial.again(way) for way in ways), key=lambda other: other.seconds, default=None)
        if best is None or (best.seconds >= trial.seconds and len(trial.coefficients) <= MOST_PIECES):
            return trial
        trial = best


def save_pieces(trial: Trial) -> Trial:
    """The trial with fewer pieces where it has more than `MOST_PIECES`: cruises are given up, shortest first."""
    excess = 0 if trial.room.in_motion else len(trial.coefficients) - MOST_PIECES
    for unwanted in range(excess, len(trial.caps) + 1) if excess > 0 else ():
        fewer = trial.again(trial.waypoints, trial.caps, unwanted)
        if fewer.fault < 0 and len(fewer.coefficients) <= MOST_PIECES:
            return fewer
    return trial


def mend_faults(trial: Trial) -> Trial:
    """The trial with its faults mended one after another, each in the way that costs least time."""
    rounds = 4 * len(trial.caps)
    while trial.fault >= 0 and rounds > 0:
        rounds -= 1
        tried = [trial.again(waypoints, caps) for waypoints, caps in trial.alternatives()]
        better = [other for other in tried if other.fault < 0 or other.fault > trial.fault]
        if better:
            trial = min(better, key=lambda other: other.seconds)
        elif (tried[-1].waypoints.rest_s != trial.waypoints.rest_s).any():
            trial = tried[-1]
        else:
            break
    return trial if trial.fault < 0 else trial.stopping()
