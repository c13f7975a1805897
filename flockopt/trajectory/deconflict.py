"""Keeping drones apart: by timing first, by geometry where time cannot do it.

Flights that meet nobody are left alone. The others are timed one after another, longest first: each takes the
(delay, slowdown) with the earliest finish that keeps it apart from all that are already timed, parked drones
included. Where no timing does, somebody stands in the way for good: a drone parked on another's way is flown
around, a drone parked on another's task moves on to a free spot, and two that meet head-on give way to one side.
Every repair is followed by timing anew, and the number of repairs is bounded, so it ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flockopt.bundles import Bundles
from flockopt.curve import Curve, Flight, Visit
from flockopt.geometry import FloatArray
from flockopt.scene import Scene
from flockopt.trajectory.detour import Detours
from flockopt.travel import Travel, compute_travel

__all__ = ["Conflict", "Deconflicted", "deconflict"]

#: Room kept beyond the separation where the starts leave any, metres.
SEPARATION_RESERVE_M = 1e-3

#: How much slower than at full speed a flight may be flown to let others pass.
SLOWDOWNS = (1.0, 1.3, 1.7)

#: Delays are tried in steps of the time a drone needs for this share of the separation at full speed.
DELAY_STEP = 0.75

#: Delays tried per flight at the most; longer horizons are searched in longer steps.
MOST_DELAYS = 160


@dataclass(frozen=True)
class Conflict:
    """Two drones that could not be kept apart, and when they first come too close."""

    drones: tuple[str, str]
    time: float

    def __str__(self) -> str:
        return f"drones {self.drones[0]!r} and {self.drones[1]!r} come too close at {self.time:.2f} s"


@dataclass(frozen=True)
class Deconflicted:
    """Flights after deconfliction, and what is left of conflicts."""

    flights: dict[str, Flight]
    unresolved: tuple[Conflict, ...]


@dataclass(frozen=True)
class _Timing:
    """When and how fast each drone flies: its flight delayed by ``delay`` seconds after slowing it down."""

    delay: float = 0.0
    slowdown: float = 1.0


def deconflict(scene: Scene, bundles: Bundles, flights: dict[str, Flight], *, travel: Travel | None = None) -> Deconflicted:
    """Keep all drones apart over the whole time, parked ones included.

    Args:
        scene: The scene; its separation (an ellipsoid if `separation_z` is given) counts between centres.
        bundles: The routes behind the flights, for drones that have to be flown another way.
        flights: One flight for each drone that moves, by id, as from `decode`; all begin at t = 0.
        travel: The scene's travel, if it is already there.

    Returns:
        The flights, delayed, slowed or rerouted; every pair that could not be kept apart is listed, never hidden.
    """
    fleet = _Fleet(scene, flights)
    if scene.separation == 0.0 or not fleet.meeting():
        return Deconflicted(flights, ())
    detours = Detours(scene, bundles, compute_travel(scene) if travel is None else travel)
    for _ in range(4 * scene.num_drones + 8):
        stuck = fleet.find_timing()
        if stuck is None:
            break
        change = detours.resolve(*stuck, fleet.curves, fleet.first_meeting(*stuck))
        if change is None:
            break
        drone, flight = change
        fleet.replace(drone, flight)
    timed = fleet.timed_flights()
    return Deconflicted(timed, _Fleet(scene, timed).conflicts())


class _Fleet:
    """All drones' curves as arrays, their timing, and who meets whom."""

    def __init__(self, scene: Scene, flights: dict[str, Flight]) -> None:
        from flockopt.continuous import parked

        self.scene = scene
        self.flights = dict(flights)
        self.axes = _reserved_axes(scene)
        self.timing = [_Timing() for _ in scene.drones]
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

    def replace(self, drone: int, flight: Flight) -> None:
        """Give a drone another flight."""
        self.flights[self.scene.drones[drone].id] = flight
        self.curves[drone] = (flight.curve.breakpoints, flight.curve.coefficients)

    def apart(self, a: int, timing_a: _Timing, b: int, timing_b: _Timing) -> bool:
        """Whether two drones, timed like this, keep apart for all time."""
        return self._meeting_time(a, timing_a, b, timing_b) < 0.0

    def _meeting_time(self, a: int, timing_a: _Timing, b: int, timing_b: _Timing) -> float:
        from flockopt.continuous import first_conflict

        first = (*self.curves[a], timing_a.delay, timing_a.slowdown)
        second = (*self.curves[b], timing_b.delay, timing_b.slowdown)
        end = max(self._finish(a, timing_a), self._finish(b, timing_b))
        return float(first_conflict(*first, *second, self.axes, 0.0, end))

    def _finish(self, drone: int, timing: _Timing) -> float:
        """When the drone comes to its end, seconds."""
        return float(self.curves[drone][0][-1]) * timing.slowdown + timing.delay

    def meeting(self) -> set[int]:
        """Drones that come too close to another one at their present timing."""
        met: set[int] = set()
        for a in range(len(self.curves)):
            for b in range(a):
                if not self.apart(a, self.timing[a], b, self.timing[b]):
                    met |= {a, b}
        return met

    def find_timing(self) -> tuple[int, int] | None:
        """Time all flights so that no two drones meet, or name a drone that finds no way and who stands in it."""
        self.timing = [_Timing() for _ in self.curves]
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
        self.timing = [_Timing() for _ in self.curves]
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
            order = timed if blocker is None else [blocker, *timed]
            blocker = next((other for other in order if not self.apart(drone, timing, other, self.timing[other])), None)
            if blocker is None:
                self.timing[drone] = timing
                return None
        return blocker

    def _options(self, drone: int, timed: list[int]) -> list[_Timing]:
        """Delays and slowdowns worth trying, by the time they finish; the last ones outwait everybody."""
        seconds = float(self.curves[drone][0][-1])
        last = max((self._finish(other, self.timing[other]) for other in timed), default=0.0)
        step = max(DELAY_STEP * self.scene.separation / self.scene.drones[drone].max_speed, last / MOST_DELAYS)
        delays = np.arange(0.0, last + 2 * step, step)
        slowdowns = SLOWDOWNS if not any(self.scene.drones[drone].velocity) else SLOWDOWNS[:1]
        if any(self.scene.drones[drone].velocity):
            delays = delays[:1]
        options = [_Timing(float(delay), slowdown) for slowdown in slowdowns for delay in delays]
        return sorted(options, key=lambda timing: (timing.delay + seconds * timing.slowdown, timing.delay))

    def first_meeting(self, a: int, b: int) -> float:
        """When two drones would first come too close if both set off at once, seconds; -1 if never."""
        return self._meeting_time(a, _Timing(), b, _Timing())

    def timed_flights(self) -> dict[str, Flight]:
        """The flights at their timing."""
        result = {}
        for drone, timing in zip(self.scene.drones, self.timing, strict=True):
            flight = self.flights.get(drone.id)
            if flight is not None:
                result[drone.id] = _retimed(flight, timing)
        return result

    def conflicts(self) -> tuple[Conflict, ...]:
        """All pairs that come too close at their present timing."""
        found = []
        for a in range(len(self.curves)):
            for b in range(a + 1, len(self.curves)):
                if not self.apart(a, self.timing[a], b, self.timing[b]):
                    pair = (self.scene.drones[a].id, self.scene.drones[b].id)
                    found.append(Conflict(pair, self.first_meeting(a, b)))
        return tuple(found)


def _reserved_axes(scene: Scene) -> FloatArray:
    """The separation's half axes with a reserve for rounding, as far as the starts leave one."""
    axes = np.array(scene.separation_axes)
    reserve = SEPARATION_RESERVE_M
    if scene.num_drones > 1 and scene.separation > 0.0:
        scaled = scene.starts / axes
        gaps = [np.linalg.norm(scaled[:i] - scaled[i], axis=1).min() for i in range(1, len(scaled))]
        reserve = min(reserve, max(0.5 * (min(gaps) - 1.0) * scene.separation, 0.0))
    return axes * (1.0 + reserve / max(scene.separation, 1e-12))


def _retimed(flight: Flight, timing: _Timing) -> Flight:
    """The flight slowed and delayed; rests longer than asked for do no harm."""
    curve = flight.curve if timing.slowdown == 1.0 else flight.curve.stretched(timing.slowdown)
    visits = tuple(Visit(visit.task, visit.time * timing.slowdown + timing.delay) for visit in flight.visits)
    return replace(flight, curve=Curve(curve.breakpoints + timing.delay, curve.coefficients), visits=visits)
