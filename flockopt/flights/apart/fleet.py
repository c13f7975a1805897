"""A fleet's curves and their timing: who meets whom, and delays that keep all apart."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from flockopt.batches import cp_sat
from flockopt.batches.deadline import NEVER, Deadline
from flockopt.errors import MissingExtra
from flockopt.flights import Curve, Flight, Visit
from flockopt.flights.apart.schedule import DOING, schedule
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.scene.apart import least_resting_share

__all__ = ["TimedFleet", "Timing"]

#: Room kept beyond the separation where the starts leave any, metres.
SEPARATION_RESERVE_M = 1e-3

#: For small drones that is less: at most this share of what must lie between them.
SEPARATION_RESERVE_SHARE = 0.01

#: How much slower than at full speed a flight may be flown to let others pass.
SLOWDOWNS = (1.0, 1.3, 1.7)

#: Delays are tried in steps of the time a drone needs for this share of the separation at full speed.
DELAY_STEP = 0.75

#: The scheduling model lets a drone wait at most this many times the longest flight.
LONGEST_WAIT = 1.5

#: Delays tried per flight at the most; longer horizons are searched in longer steps.
MOST_DELAYS = 120


@dataclass(frozen=True)
class Timing:
    """When and how fast each drone flies: its flight delayed by ``delay`` seconds after slowing it down."""

    delay: float = 0.0
    slowdown: float = 1.0


class TimedFleet:
    """All drones' curves as arrays, their timing, and who meets whom."""

    def __init__(self, scene: Scene, flights: dict[str, Flight], deadline: Deadline = NEVER) -> None:
        from flockopt.geometry.continuous import parked

        self.scene, self.deadline = scene, deadline
        self.flights = dict(flights)
        self.reserve_m = _reserve(scene)
        self._axes: dict[float, FloatArray] = {}  # by the sum of two radii
        self.timing = [Timing() for _ in scene.drones]
        self.curves: list[tuple[FloatArray, FloatArray]] = []
        for drone in scene.drones:
            flight = flights.get(drone.id)
            self.curves.append(
                parked(np.array(drone.start)) if flight is None else (flight.curve.breakpoints, flight.curve.coefficients)
            )
        self.front: list[int] = []  # drones timed before all others, because they found no way otherwise

    def moves(self, drone: int) -> bool:
        """Whether the drone has a flight."""
        return self.scene.drones[drone].id in self.flights

    def _in_motion(self, drone: int) -> bool:
        """Whether the drone already flies at the start, so that it can neither wait nor slow down."""
        record = self.scene.drones[drone]
        return any(record.velocity) or any(record.acceleration)

    def replace(self, drone: int, flight: Flight) -> None:
        """Give a drone another flight."""
        self.flights[self.scene.drones[drone].id] = flight
        self.curves[drone] = (flight.curve.breakpoints, flight.curve.coefficients)

    def axes(self, a: int, b: int) -> FloatArray:
        """(3,) m, half axes of what the two keep between them, with the reserve."""
        bodies = self.scene.drones[a].radius + self.scene.drones[b].radius
        if bodies not in self._axes:
            axes = self.scene.axes_between(a, b)
            self._axes[bodies] = axes * (1.0 + self.reserve_m / axes[0])
        return self._axes[bodies]

    def apart(self, a: int, timing_a: Timing, b: int, timing_b: Timing) -> bool:
        """Whether two drones, timed like this, keep apart for all time."""
        return self._meeting_time(a, timing_a, b, timing_b) < 0.0

    def _meeting_time(self, a: int, timing_a: Timing, b: int, timing_b: Timing) -> float:
        from flockopt.geometry.continuous import first_conflict

        first = (*self.curves[a], timing_a.delay, timing_a.slowdown)
        second = (*self.curves[b], timing_b.delay, timing_b.slowdown)
        end = max(self._finish(a, timing_a), self._finish(b, timing_b))
        return float(first_conflict(*first, *second, self.axes(a, b), 0.0, end))

    def _finish(self, drone: int, timing: Timing) -> float:
        """When the drone comes to its end, seconds."""
        return float(self.curves[drone][0][-1]) * timing.slowdown + timing.delay

    def meeting(self) -> set[int]:
        """Drones that come too close to another one at their present timing."""
        return {drone for a, b, _ in self.conflicts() for drone in (a, b)}

    def find_timing(self) -> tuple[int, int] | None:
        """Time all flights so that no two drones meet, or name a drone that finds no way and who stands in it."""
        return None if self._scheduled() else self._one_after_another()

    def _scheduled(self) -> bool:
        """Delay flights as the scheduling model says; False where that finds nothing, is not installed, or there is no time."""
        if not cp_sat.is_at_hand(self.deadline):
            return False
        longest = max(float(curve[0][-1]) for curve in self.curves)
        step = self._delay_step(longest)
        waits = [self.moves(drone) and not self._in_motion(drone) for drone in range(len(self.curves))]
        try:
            most = int(np.ceil(LONGEST_WAIT * longest / step))
            delays = schedule(self.curves, waits, self.axes, step, most, self.deadline)
        except MissingExtra:
            return False
        if delays is None:
            return False
        self.timing = [Timing(float(delay)) for delay in delays]
        return True

    def _delay_step(self, horizon: float) -> float:
        """Seconds between the delays to try within ``horizon`` seconds."""
        fastest = max(drone.max_speed for drone in self.scene.drones)
        return max(DELAY_STEP * float(self.scene.widest_axes[0]) / fastest, horizon / MOST_DELAYS)

    def _one_after_another(self) -> tuple[int, int] | None:
        """Time flights in order, those first that found no way before; see `find_timing`."""
        self.timing = [Timing() for _ in self.curves]
        met = self.meeting()
        for _ in range(len(self.curves) + 1):
            stuck = self._time_in_order(met)
            if stuck is None or stuck[0] in self.front[:1]:
                return stuck
            self.front = [stuck[0]] + [drone for drone in self.front if drone != stuck[0]]
            met.add(stuck[0])
        return stuck

    def _time_in_order(self, met: set[int]) -> tuple[int, int] | None:
        """Time the drones of ``met`` one after another around all others; see `find_timing`."""
        self.timing = [Timing() for _ in self.curves]
        timed = [drone for drone in range(len(self.curves)) if drone not in met or not self.moves(drone)]
        waiting = sorted(met - set(timed), key=lambda drone: (-self.curves[drone][0][-1], drone))
        waiting.sort(key=lambda drone: self.front.index(drone) if drone in self.front else len(self.front))
        for drone in waiting:
            blocker = self._time_one(drone, timed)
            if blocker is not None:
                return drone, blocker
            timed.append(drone)
        return None

    def _time_one(self, drone: int, timed: list[int]) -> int | None:
        """Give one drone the earliest finish apart from those already timed; else name who blocks it to the last."""
        blocker = None
        for timing in self._options(drone, timed):
            self.deadline.check(DOING)
            order = timed if blocker is None else [blocker, *timed]
            blocker = next((other for other in order if not self.apart(drone, timing, other, self.timing[other])), None)
            if blocker is None:
                self.timing[drone] = timing
                return None
        return blocker

    def _options(self, drone: int, timed: list[int]) -> list[Timing]:
        """Delays and slowdowns worth trying, by the time they finish; the last ones outwait everybody."""
        seconds = float(self.curves[drone][0][-1])
        last = max((self._finish(other, self.timing[other]) for other in timed), default=0.0)
        step = self._delay_step(last)
        delays = np.arange(0.0, last + 2 * step, step)
        if self._in_motion(drone):
            return [Timing()]
        options = [Timing(float(delay), slowdown) for slowdown in SLOWDOWNS for delay in delays]
        return sorted(options, key=lambda timing: (timing.delay + seconds * timing.slowdown, timing.delay))

    def first_meeting(self, a: int, b: int) -> float:
        """When two drones would first come too close if both set off at once, seconds; -1 if never."""
        return self._meeting_time(a, Timing(), b, Timing())

    def timed_flights(self) -> dict[str, Flight]:
        """The flights at their timing."""
        result = {}
        for drone, timing in zip(self.scene.drones, self.timing, strict=True):
            flight = self.flights.get(drone.id)
            if flight is not None:
                result[drone.id] = _retimed(flight, timing)
        return result

    def conflicts(self) -> list[tuple[int, int, float]]:
        """All pairs of drones that come too close at their present timing, and when they first do, seconds."""
        pairs = combinations(range(len(self.curves)), 2)
        found = []
        for a, b in pairs:
            self.deadline.check(DOING)
            time = self._meeting_time(a, self.timing[a], b, self.timing[b])
            if time >= 0.0:
                found.append((a, b, time))
        return found


def _reserve(scene: Scene) -> float:
    """Metres kept beyond what must lie between two drones, for rounding, as far as starts and places of rest leave them."""
    tightest = float(scene.widest_axes[0]) if scene.num_drones > 1 else math.inf
    reserve = min(SEPARATION_RESERVE_M, SEPARATION_RESERVE_SHARE * tightest)
    reserve = min(reserve, max(0.5 * (least_resting_share(scene) - 1.0) * tightest, 0.0))
    for i in range(1, scene.num_drones):
        axes = scene.axes_between(np.arange(i), i)  # (i, 3)
        gaps = np.linalg.norm((scene.starts[:i] - scene.starts[i]) / axes, axis=1)
        reserve = min(reserve, float(max((0.5 * (gaps - 1.0) * axes[:, 0]).min(), 0.0)))
    return reserve


def _retimed(flight: Flight, timing: Timing) -> Flight:
    """The flight slowed and delayed; rests longer than asked for do no harm."""
    curve = flight.curve if timing.slowdown == 1.0 else flight.curve.stretched(timing.slowdown)
    visits = tuple(Visit(visit.task, visit.time * timing.slowdown + timing.delay) for visit in flight.visits)
    return replace(flight, curve=Curve(curve.breakpoints + timing.delay, curve.coefficients), visits=visits)
