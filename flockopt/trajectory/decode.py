"""From bundles to flights: each drone through its tasks, smooth, within limits and clear of obstacles.

The closed form of `flockopt.trajectory.blend` flies a drone's waypoints without stopping. Passing exactly through
a waypoint swings the curve a little to its outside; where that leaves the free space, the curve is mended there:
slower legs swing less, and a drone that stops at a waypoint does not swing at all, so that the worst case is the
polyline itself, which is clear.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from flockopt.bundles import Bundles
from flockopt.curve import Curve, Flight
from flockopt.errors import SettingsError
from flockopt.geometry import FloatArray
from flockopt.scene import Drone, Scene
from flockopt.trajectory.room import MOST_PIECES, Room
from flockopt.trajectory.waypoints import FLY_THROUGH, Waypoints, check_samples, waypoints_from_paths, waypoints_from_samples
from flockopt.travel import Travel, compute_travel

__all__ = ["LAWS", "Law", "decode", "fly"]

#: Slower legs tried beside a fault, as shares of the speed they had, before stopping is considered.
SLOWER_SHARES = (0.7, 0.45)

#: Speeds tried on the first leg of a drone that starts in motion, as shares of its limit.
ENTRY_SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)

#: Share of the limits that flights from a moving start are planned for: no time scaling takes up what is left of them.
MOVING_SHARE = 0.98

#: By how much the entry from a moving start may pass the limits as they are used: half of what is held in reserve.
ENTRY_TOLERANCE = 5e-4

#: Seconds a drone that serves a task where it stands is given for it.
SHORTEST_FLIGHT_S = 0.1


def decode(
    scene: Scene,
    bundles: Bundles,
    samples: ArrayLike | None = None,
    *,
    travel: Travel | None = None,
    law: str = "fly-through",
) -> dict[str, Flight]:
    """Smooth flights through ordered bundles.

    Args:
        scene: The scene.
        bundles: Which drone visits which tasks in which order.
        samples: (N, T, 3) m, control points between the anchors (start, tasks, end) of each drone; None to follow
            the any-angle paths.
        travel: The scene's travel, if it is already there.
        law: How progress along the way is timed; see `LAWS`.

    Returns:
        A flight for every drone that moves or serves a task, by drone id, all beginning at t = 0. Position, velocity
        and acceleration are continuous, limits hold exactly, and the flight is clear of obstacles where the waypoints
        allow it at all (the judge has the last word). Drones may still meet each other: see `deconflict`.

    Raises:
        SettingsError: On an unknown law, bundles for another fleet, or samples of a wrong shape or with a NaN.
    """
    chosen = _chosen_law(scene, law)
    if len(bundles) != scene.num_drones:
        rule = f"must hold {scene.num_drones} bundles, one a drone"
        raise SettingsError("bundles", f"hold {len(bundles)}", rule, "plan for this scene")
    control = None if samples is None else check_samples(scene, samples)
    travel = compute_travel(scene) if travel is None else travel
    flights, ways = {}, {}
    for index, (drone, route) in enumerate(zip(scene.drones, bundles, strict=True)):
        if control is None:
            waypoints = waypoints_from_paths(scene, travel, index, route)
        else:
            waypoints = chosen.from_samples(scene, travel, index, route, control[index])
        if waypoints.moves:
            ways[index] = waypoints
        elif route or np.any(drone.velocity):
            flights[drone.id] = _stay(scene, drone, waypoints)
    flights |= chosen.fly(scene, ways)
    return {drone.id: flights[drone.id] for drone in scene.drones if drone.id in flights}


def _chosen_law(scene: Scene, name: str) -> Law:
    if name not in LAWS:
        raise SettingsError("law", f"is {name!r}", f"must be one of {', '.join(LAWS)}", "choose one")
    for index, drone in enumerate(scene.drones):
        if LAWS[name].from_rest and (any(drone.velocity) or any(drone.acceleration)):
            rule = f"must be zero, with the acceleration, for law {name!r}, which starts from rest"
            raise SettingsError(f"drones[{index}].velocity", f"is {drone.velocity}", rule, "take law 'fly-through'")
    return LAWS[name]


def fly(scene: Scene, drone: Drone, waypoints: Waypoints, avoided: FloatArray | None = None) -> Flight:
    """One drone's flight through its waypoints by the fly-through law, mended where it is not clear.

    Args:
        scene: The scene.
        drone: Who flies.
        waypoints: Where it flies.
        avoided: (K, 9) more obstacle rows to keep clear of, or None.
    """
    if not waypoints.moves:
        return _stay(scene, drone, waypoints)
    room = Room.around(scene, drone, waypoints, avoided)
    best = _mended(_widened(_entering(waypoints, room), room), room)
    if drone.max_distance is not None and Curve(best.breakpoints, best.coefficients).length > drone.max_distance:
        best = _Trial.make(replace(waypoints, rest_s=np.maximum(waypoints.rest_s, 0.0)), room)
    return _shortened(best, room).flight(scene)


@dataclass(frozen=True)
class Law:
    """A way to make flights of waypoints.

    Attributes:
        fly: From the waypoints that move, by drone index, to flights by drone id.
        from_samples: How a proposal's samples become waypoints.
        from_rest: Whether drones that move already are refused.
    """

    fly: Callable[[Scene, Mapping[int, Waypoints]], dict[str, Flight]]
    from_samples: Callable[[Scene, Travel, int, Sequence[int], FloatArray], Waypoints] = waypoints_from_samples
    from_rest: bool = False


def _fly_through(scene: Scene, ways: Mapping[int, Waypoints]) -> dict[str, Flight]:
    return {scene.drones[index].id: fly(scene, scene.drones[index], waypoints) for index, waypoints in ways.items()}


def _quintic(scene: Scene, ways: Mapping[int, Waypoints]) -> dict[str, Flight]:
    from flockopt.trajectory.quintic import decode_quintic

    return decode_quintic(scene, ways).flights


def _quintic_samples(scene: Scene, travel: Travel, drone: int, route: Sequence[int], samples: FloatArray) -> Waypoints:
    from flockopt.trajectory.correction import corrected_samples

    return corrected_samples(scene, travel, drone, route, samples)


#: The laws by name: without stops; and the paper's, which stops at every anchor.
LAWS: dict[str, Law] = {"fly-through": Law(_fly_through), "quintic": Law(_quintic, _quintic_samples, from_rest=True)}


def _stay(scene: Scene, drone: Drone, waypoints: Waypoints) -> Flight:
    """The flight of a drone that serves its tasks where it stands, or brakes to a halt and returns."""
    if np.any(drone.velocity) or np.any(drone.acceleration):
        start = waypoints.points[0]
        there = start + np.array(drone.velocity) * drone.max_speed / drone.flyable_acceleration
        rest_s = np.array([FLY_THROUGH, FLY_THROUGH, 0.0])
        loop = Waypoints(np.array([start, there, start]), rest_s, ((), (), waypoints.tasks[0]))
        return _Trial.make(loop, Room.around(scene, drone, loop)).flight(scene)
    seconds = max(float(waypoints.rest_s[0]), SHORTEST_FLIGHT_S)
    curve = Curve(np.array([0.0, seconds]), waypoints.points[0].reshape(1, 3, 1))
    return Flight(curve, waypoints.visits(scene, np.zeros(1)))


@dataclass(frozen=True)
class _Trial:
    """A flight of given waypoints at given speeds, and where it first leaves the free space."""

    waypoints: Waypoints
    caps: FloatArray  # (n,) m/s on each leg
    breakpoints: FloatArray  # (P + 1,) s
    coefficients: FloatArray  # (P, 3, D)
    times: FloatArray  # (n + 1,) s at each waypoint
    fault: int  # owner of the first piece that is not clear (2 k: around point k, 2 k + 1: the leg after it), or -1

    @classmethod
    def make(cls, waypoints: Waypoints, room: Room, caps: FloatArray | None = None, unwanted: int = 0) -> _Trial:
        from flockopt.continuous import curve_clear
        from flockopt.trajectory.blend import first_outside, fly_polyline

        limits = room.limits * MOVING_SHARE if room.in_motion else room.limits
        if caps is None:
            caps = np.full(len(waypoints.points) - 1, limits[0])
        breakpoints, coefficients, times, owners = fly_polyline(
            waypoints.points, waypoints.rest_s, caps, limits, room.velocity, room.acceleration, unwanted
        )
        blocked = curve_clear(room.table, room.boxes, room.needs, breakpoints, coefficients)
        outside = first_outside(room.lower, room.upper, breakpoints, coefficients)
        faults = [int(owners[piece]) for piece in (blocked, outside) if piece >= 0]
        return cls(waypoints, caps, breakpoints, coefficients, times, min(faults, default=-1))

    @property
    def seconds(self) -> float:
        """How long the flight takes."""
        return float(self.breakpoints[-1])

    def enters(self, room: Room) -> bool:
        """Whether the limits are kept, which a moving start may make impossible."""
        from flockopt.bernstein import control_points, largest_norm

        control = control_points(self.breakpoints, self.coefficients, self.coefficients.shape[2])
        norms = [largest_norm(self.breakpoints, control, order)[0] for order in (1, 2, 3)]
        return bool((norms <= room.limits * (1.0 + ENTRY_TOLERANCE)).all())

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


def _entering(waypoints: Waypoints, room: Room) -> _Trial:
    """The first trial; of a drone that starts in motion, at the highest speed of its first leg that it can enter."""
    trial = _Trial.make(waypoints, room)
    if not room.in_motion:
        return trial
    for share in ENTRY_SHARES:
        slower = _Trial.make(waypoints, room, np.concatenate([trial.caps[:1] * share, trial.caps[1:]]))
        if slower.enters(room):
            return slower
    return trial


def _widened(trial: _Trial, room: Room) -> _Trial:
    """The trial with close corners merged as long as that saves time, or pieces of which there are too many."""
    from flockopt.trajectory.corners import merged_corners

    while True:
        ways = merged_corners(trial.waypoints, room.table, room.boxes, room.needs, room.lower, room.upper)
        best = min((_Trial.make(way, room) for way in ways), key=lambda other: other.seconds, default=None)
        if best is None or (best.seconds >= trial.seconds and len(trial.coefficients) <= MOST_PIECES):
            return trial
        trial = best


def _shortened(trial: _Trial, room: Room) -> _Trial:
    """The trial with fewer pieces where it has more than `MOST_PIECES`: cruises are given up, shortest first."""
    excess = 0 if room.in_motion else len(trial.coefficients) - MOST_PIECES
    for unwanted in range(excess, len(trial.caps) + 1) if excess > 0 else ():
        fewer = _Trial.make(trial.waypoints, room, trial.caps, unwanted)
        if fewer.fault < 0 and len(fewer.coefficients) <= MOST_PIECES:
            return fewer
    return trial


def _mended(trial: _Trial, room: Room) -> _Trial:
    """The trial with its faults mended one after another, each in the way that costs least time."""
    rounds = 4 * len(trial.caps)
    while trial.fault >= 0 and rounds > 0:
        rounds -= 1
        tried = [_Trial.make(waypoints, room, caps) for waypoints, caps in trial.alternatives()]
        better = [other for other in tried if other.fault < 0 or other.fault > trial.fault]
        if better:
            trial = min(better, key=lambda other: other.seconds)
        elif (tried[-1].waypoints.rest_s != trial.waypoints.rest_s).any():
            trial = tried[-1]
        else:
            break
    if trial.fault >= 0:
        stopping = replace(trial.waypoints, rest_s=np.maximum(trial.waypoints.rest_s, 0.0))
        return _Trial.make(stopping, room)
    return trial
