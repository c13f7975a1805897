"""From bundles to flights: each drone through its tasks, smooth, within limits and clear of obstacles.

`LAWS` says by which law. The closed form of `flockopt.flights.laws.fly_through` flies a drone's waypoints without stopping;
where passing exactly through a waypoint swings the curve out of the free space, it is mended there
(`flockopt.flights.laws.attempt`). `flockopt.flights.laws.ruckig_law` does the same by profiles from ruckig, and
`flockopt.flights.laws.quintic` is the decoder of the paper, which stops at every anchor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.bundles import Bundles
from flockopt.errors import SettingsError
from flockopt.flights.curve import Curve, Flight
from flockopt.flights.room import MOST_PIECES, Room
from flockopt.flights.waypoints import Waypoints, check_samples, waypoints_from_paths, waypoints_from_samples
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel

if TYPE_CHECKING:
    from flockopt.flights.laws.attempt import PolylineLaw

__all__ = ["LAWS", "Law", "decode", "fly"]

#: What it does, for those who give it a deadline.
DOING = "making flights of the routes"

#: Seconds a drone that serves a task where it stands is given for it.
SHORTEST_FLIGHT_S = 0.1


def decode(
    scene: Scene,
    bundles: Bundles,
    samples: ArrayLike | None = None,
    *,
    travel: Travel | None = None,
    law: str = "fly-through",
    deadline: Deadline = NEVER,
) -> dict[str, Flight]:
    """Smooth flights through ordered bundles.

    Args:
        scene: The scene.
        bundles: Which drone visits which tasks in which order.
        samples: (N, T, 3) m, control points between the anchors (start, tasks, end) of each drone; None to follow
            the any-angle paths.
        travel: The scene's travel, if it is already there.
        law: How progress along the way is timed; see `LAWS`.
        deadline: When to give up.

    Returns:
        A flight for every drone that moves or serves a task, by drone id, all beginning at t = 0. Position, velocity
        and acceleration are continuous, limits hold exactly, and the flight is clear of obstacles where the waypoints
        allow it at all (the judge has the last word). Drones may still meet each other: see `deconflict`.

    Raises:
        SettingsError: On an unknown law, one that starts from rest for a drone in motion, bundles for another fleet,
            or samples of a wrong shape or with a NaN.
        MissingExtra: If the law is "ruckig" and ruckig is not installed.
        OutOfTime: If the deadline passes.
    """
    chosen = _chosen_law(scene, law)
    if len(bundles) != scene.num_drones:
        rule = f"must hold {scene.num_drones} bundles, one a drone"
        raise SettingsError("bundles", f"hold {len(bundles)}", rule, "plan for this scene")
    control = None if samples is None else check_samples(scene, samples)
    travel = compute_travel(scene) if travel is None else travel
    flights, ways = {}, {}
    for index, (drone, route) in enumerate(zip(scene.drones, bundles, strict=True)):
        deadline.check(DOING)
        if control is None:
            waypoints = waypoints_from_paths(scene, travel, index, route)
        else:
            waypoints = chosen.from_samples(scene, travel, index, route, control[index])
        if waypoints.moves:
            ways[index] = waypoints
        elif route or np.any(drone.velocity):
            flights[drone.id] = fly(scene, drone, waypoints)
    flights |= chosen.fly(scene, ways, deadline)
    return {drone.id: flights[drone.id] for drone in scene.drones if drone.id in flights}


def _chosen_law(scene: Scene, name: str) -> Law:
    if name not in LAWS:
        raise SettingsError("law", f"is {name!r}", f"must be one of {', '.join(LAWS)}", "choose one")
    for index, drone in enumerate(scene.drones):
        if LAWS[name].from_rest and (any(drone.velocity) or any(drone.acceleration)):
            rule = f"must be zero, with the acceleration, for law {name!r}, which starts from rest"
            raise SettingsError(f"drones[{index}].velocity", f"is {drone.velocity}", rule, "take law 'fly-through'")
    return LAWS[name]


def fly(
    scene: Scene, drone: Drone, waypoints: Waypoints, avoided: FloatArray | None = None, law: PolylineLaw | None = None
) -> Flight:
    """One drone's flight through its waypoints without stopping, mended where it is not clear.

    Args:
        scene: The scene.
        drone: Who flies.
        waypoints: Where it flies.
        avoided: (K, 9) more obstacle rows to keep clear of, or None.
        law: What flies a polyline; None for the fly-through law, `flockopt.flights.laws.fly_through.fly_polyline`.
    """
    from flockopt.flights.laws.attempt import first_trial, halting_ways, mend_faults, merge_close_corners, save_pieces
    from flockopt.flights.laws.fly_through import fly_polyline

    chosen, room = law or fly_polyline, Room.around(scene, drone, waypoints, avoided)
    if not waypoints.moves and not room.in_motion:
        return _stay(waypoints, scene)
    ways = [waypoints] if waypoints.moves else []
    halting = halting_ways(waypoints, room, bool(waypoints.tasks[0]) or drone.end is not None) if room.in_motion else ()
    trials = []
    for way in chain(ways, halting):
        trial = mend_faults(merge_close_corners(first_trial(way, room, chosen)))
        if drone.max_distance is not None and Curve(trial.breakpoints, trial.coefficients).length > drone.max_distance:
            trial = trial.again(way).stopping()
        trials.append(trial)
        if not room.in_motion or trial.is_flyable:
            break
    else:
        trial = trials[0]
    return save_pieces(trial).flight(scene)


@dataclass(frozen=True)
class Law:
    """A way to make flights of waypoints.

    Attributes:
        fly: From the waypoints that move, by drone index, to flights by drone id, by a deadline.
        from_samples: How a proposal's samples become waypoints.
        from_rest: Whether drones that move already are refused.
    """

    fly: Callable[[Scene, Mapping[int, Waypoints], Deadline], dict[str, Flight]]
    from_samples: Callable[[Scene, Travel, int, Sequence[int], FloatArray], Waypoints] = waypoints_from_samples
    from_rest: bool = False


def _fly_through(scene: Scene, ways: Mapping[int, Waypoints], deadline: Deadline) -> dict[str, Flight]:
    flights = {}
    for index, waypoints in ways.items():
        deadline.check(DOING)
        flights[scene.drones[index].id] = fly(scene, scene.drones[index], waypoints)
    return flights


def _quintic(scene: Scene, ways: Mapping[int, Waypoints], deadline: Deadline) -> dict[str, Flight]:
    from flockopt.flights.laws.quintic import decode_quintic

    return decode_quintic(scene, ways).flights


def _quintic_samples(scene: Scene, travel: Travel, drone: int, route: Sequence[int], samples: FloatArray) -> Waypoints:
    from flockopt.flights.laws.correction import corrected_samples

    return corrected_samples(scene, travel, drone, route, samples)


def _ruckig(scene: Scene, ways: Mapping[int, Waypoints], deadline: Deadline) -> dict[str, Flight]:
    from flockopt.flights.laws import ruckig_law

    flights = {}
    for index, waypoints in ways.items():
        deadline.check(DOING)
        drone = scene.drones[index]
        flight = fly(scene, drone, waypoints, law=ruckig_law.fly_polyline)
        if flight.curve.num_pieces > MOST_PIECES:
            flight = min(flight, fly(scene, drone, waypoints), key=lambda one: one.curve.num_pieces)
        flights[drone.id] = flight
    return flights


#: The laws by name: without stops; the paper's, which stops at every anchor; without stops, by jerk-limited profiles
#: from ruckig, or as the first where those take more pieces than a trajectory memory holds.
LAWS: dict[str, Law] = {
    "fly-through": Law(_fly_through),
    "quintic": Law(_quintic, _quintic_samples, from_rest=True),
    "ruckig": Law(_ruckig),
}


def _stay(waypoints: Waypoints, scene: Scene) -> Flight:
    """The flight of a drone that serves its tasks where it stands."""
    seconds = max(float(waypoints.rest_s[0]), SHORTEST_FLIGHT_S)
    curve = Curve(np.array([0.0, seconds]), waypoints.points[0].reshape(1, 3, 1))
    return Flight(curve, waypoints.visits(scene, np.zeros(1)))
