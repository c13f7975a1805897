"""Keeping drones apart: by timing first, by geometry where time cannot do it.

Flights that meet nobody are left alone. Otherwise a small scheduling model delays some so that nobody meets and the
last finishes as early as it can (`flockopt.flights.apart.schedule`); where it finds nothing, or OR-Tools is not
installed, drones are delayed or slowed one after another. Where no timing helps, somebody stands in the way for
good: a drone parked on another's way is flown around, a drone parked on another's task moves on to a free spot, and
two that meet head-on give way to one side. Every repair is followed by timing anew, and the number of repairs is
bounded, so it ends.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.bundles import Bundles
from flockopt.flights import Flight
from flockopt.flights.apart.detour import Detours
from flockopt.flights.apart.fleet import TimedFleet
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel

__all__ = ["Conflict", "Deconflicted", "deconflict"]


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


def deconflict(
    scene: Scene,
    bundles: Bundles,
    flights: dict[str, Flight],
    *,
    travel: Travel | None = None,
    airborne: Collection[str] = (),
    deadline: Deadline = NEVER,
) -> Deconflicted:
    """Keep all drones apart over the whole time, parked ones included.

    Args:
        scene: The scene; what `Scene.axes_between` says counts between centres.
        bundles: The routes behind the flights, for drones that have to be flown another way.
        flights: One flight for each drone that moves, by id, as from `decode`; all begin at t = 0.
        travel: The scene's travel, if it is already there.
        airborne: Ids of drones that may make way although they have no capacity: it is used up, and they hover.
        deadline: When to give up.

    Returns:
        The flights, delayed, slowed or rerouted; every pair that could not be kept apart is listed, never hidden.

    Raises:
        OutOfTime: If the deadline passes.
    """
    fleet = TimedFleet(scene, flights, deadline)
    if not fleet.meeting():
        return Deconflicted(flights, ())
    detours = Detours(scene, bundles, compute_travel(scene) if travel is None else travel, airborne, deadline)
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
    met = TimedFleet(scene, timed, deadline).conflicts()
    left = [Conflict((scene.drones[a].id, scene.drones[b].id), time) for a, b, time in met]
    return Deconflicted(timed, tuple(left))
