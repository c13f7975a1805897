"""Other ways for drones that stand in each other's way: flying around, and moving on to a free spot."""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise

import numpy as np

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.bundles import Bundles
from flockopt.flights import Flight
from flockopt.flights.decode import fly
from flockopt.flights.waypoints import Waypoints, waypoints_from_paths
from flockopt.geometry.distances import OBSTACLE_COLUMNS, SPHERE, distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.roadmap import Roadmap, roadmap_among

__all__ = ["Detours"]

#: Room kept around what is flown around, and around a free spot, metres.
DETOUR_RESERVE_M = 5e-3

#: For small drones that is less: at most this share of what must lie between two of them.
DETOUR_RESERVE_SHARE = 0.05

#: What ways keep from obstacles beyond what they must, against rounding, metres.
ROUNDING_M = 1e-6

#: Distances at which a free spot is looked for, in separations, and directions a ring.
SPOT_RINGS = (1.1, 1.5, 2.0, 3.0, 5.0, 8.0)
SPOT_DIRECTIONS = 12


class Detours:
    """The geometry of a fleet's flights as repairs change it.

    Args:
        scene: The scene.
        bundles: The drones' routes.
        travel: The paths behind them.
        airborne: Ids of drones that may make way although they have no capacity.
        deadline: When to give up.
    """

    def __init__(
        self, scene: Scene, bundles: Bundles, travel: Travel, airborne: Collection[str] = (), deadline: Deadline = NEVER
    ) -> None:
        self.scene, self.bundles, self.travel, self.airborne, self.deadline = scene, bundles, travel, airborne, deadline
        self.reserve_m = min(DETOUR_RESERVE_M, DETOUR_RESERVE_SHARE * float(scene.widest_axes[0]))
        self.avoided: dict[int, list[tuple[int, FloatArray]]] = {}  # by drone: whom, and where
        self.spots: dict[int, FloatArray] = {}

    def resolve(
        self, drone: int, blocker: int, curves: list[tuple[FloatArray, FloatArray]], meeting_s: float
    ) -> tuple[int, Flight] | None:
        """A new flight for one of two drones that no timing keeps apart, or None when nothing is left to try.

        Args:
            drone: The drone that finds no time to fly.
            blocker: Who stands in its way to the last.
            curves: Breakpoints and coefficients of all drones.
            meeting_s: When the two first meet if both set off at once; -1 if they don't.
        """
        parking = _position(curves[blocker], np.inf)
        if self._inside(self._anchors(drone), parking, drone, blocker).any():
            flight = self._moved_on(blocker, parking, curves)
            if flight is not None:
                return blocker, flight
        else:
            flight = self._around(drone, blocker, parking)
            if flight is not None:
                return drone, flight
        own = _position(curves[drone], np.inf)
        if self._inside(self._anchors(blocker), own, blocker, drone).any():  # it is the drone itself that stays in the way
            flight = self._moved_on(drone, own, curves)
            if flight is not None:
                return drone, flight
        for one, other in ((drone, blocker), (blocker, drone)) if meeting_s >= 0.0 else ():
            flight = self._around(one, other, _position(curves[other], meeting_s)) if self._travels(one) else None
            if flight is not None:
                return one, flight
        flight = self._moved_on(blocker, parking, curves)  # beside the other's way, which cannot lead around it
        return None if flight is None else (blocker, flight)

    def _moved_on(self, drone: int, parking: FloatArray, curves: list[tuple[FloatArray, FloatArray]]) -> Flight | None:
        """The flight of a drone that leaves the place where it would park; None if it may not, or did already."""
        if drone in self.spots or not self._may_move_on(drone):
            return None
        spot = self._free_spot(drone, parking, curves)
        return None if spot is None else self._onward(drone, spot)

    def _travels(self, drone: int) -> bool:
        """Whether a drone has somewhere to go: a task, or an end elsewhere."""
        record = self.scene.drones[drone]
        return bool(self.bundles[drone]) or record.end_point not in (None, record.start)

    def _anchors(self, drone: int) -> FloatArray:
        """Start, tasks and end of a drone, and its free spot if it has one: (K, 3) m."""
        end = self.scene.ends[drone : drone + 1]
        anchors = [self.scene.starts[drone : drone + 1], self.scene.task_positions[list(self.bundles[drone])]]
        anchors += [end] if not np.isnan(end).any() else []
        return np.vstack(anchors + ([self.spots[drone][None]] if drone in self.spots else []))

    def _inside(self, points: FloatArray, center: FloatArray, drone: int, other: int) -> FloatArray:
        """At which points a drone is too near to another one at ``center``, the reserve included."""
        axes = self.scene.axes_between(drone, other) + self.reserve_m
        return np.asarray(np.linalg.norm((points - center) / axes, axis=-1) < 1.0)

    def _around(self, drone: int, other: int, center: FloatArray) -> Flight | None:
        """The drone's flight around everything it is to avoid and another at ``center`` too; None if there is no such way."""
        avoided = self.avoided.setdefault(drone, [])
        is_known = any(np.allclose(center, known) for _, known in avoided)
        if is_known or self._inside(self._anchors(drone), center, drone, other).any():
            return None
        avoided.append((other, center))
        flight = self._flown(drone)
        if flight is None:
            avoided.pop()
        return flight

    def _flown(self, drone: int) -> Flight | None:
        """The drone's flight as it is led now; None if there is no way, or none that is short enough for it."""
        waypoints, record = self._waypoints(drone), self.scene.drones[drone]
        if waypoints is None:
            return None
        flight = fly(self.scene, record, waypoints, self._balls(drone))
        return None if record.max_distance is not None and flight.curve.length > record.max_distance else flight

    def _onward(self, drone: int, spot: FloatArray) -> Flight | None:
        """The drone's flight with a last leg on to a free spot; None if what it avoids closes the way there."""
        self.spots[drone] = spot
        flight = self._flown(drone)
        if flight is None:
            del self.spots[drone]
        return flight

    def _balls(self, drone: int) -> FloatArray:
        """What the drone is to avoid, as obstacle rows: balls that hold the ellipsoid that it keeps from the other."""
        body, rows = self.scene.drones[drone].radius + self.scene.clearance, []
        for other, center in self.avoided.get(drone, []):
            radius = max(float(self.scene.axes_between(drone, other).max()) - body, 0.0) + self.reserve_m
            rows.append((SPHERE, *center, *(radius,) * 3, 1.0, 0.0))
        return np.array(rows).reshape(-1, len(OBSTACLE_COLUMNS))

    def _waypoints(self, drone: int) -> Waypoints | None:
        """The drone's waypoints with legs led around what it avoids, and on to its free spot; None if there is no way."""
        route = self.bundles[drone]
        legs = self._legs(drone, waypoints_from_paths(self.scene, self.travel, drone, route), route)
        balls = self._balls(drone)
        if drone in self.spots:
            legs.append(np.vstack([legs[-1][-1] if legs else self.scene.starts[drone], self.spots[drone]]))
        if not legs:  # it only comes to a halt
            return None
        if len(balls):
            roadmap = self._roadmap(drone).with_balls(balls, self.deadline)
            legs = [roadmap.path(leg[0], leg[-1], self.deadline)[1] for leg in legs]
            if any(len(leg) == 0 for leg in legs):
                return None
        return Waypoints.join(self.scene, route, legs)

    def _legs(self, drone: int, waypoints: Waypoints, route: tuple[int, ...]) -> list[FloatArray]:
        """The drone's way split where it serves tasks."""
        cuts = [0] + [k for k, tasks in enumerate(waypoints.tasks) for _ in tasks]
        if cuts[-1] < len(waypoints.points) - 1:
            cuts.append(len(waypoints.points) - 1)
        return [waypoints.points[a : b + 1] for a, b in pairwise(cuts)]

    def _roadmap(self, drone: int) -> Roadmap:
        """Ways of the drone among the scene's own obstacles."""
        need = self.scene.drones[drone].radius + self.scene.clearance + ROUNDING_M
        return roadmap_among(self.scene.obstacle_table, need, (self.scene.bounds.lower, self.scene.bounds.upper))

    def _may_move_on(self, drone: int) -> bool:
        """Whether a drone may leave the place where it would park: it has no end and is not grounded."""
        record = self.scene.drones[drone]
        return record.end is None and (record.capacity > 0 or record.id in self.airborne)

    def _free_spot(self, drone: int, parking: FloatArray, curves: list[tuple[FloatArray, FloatArray]]) -> FloatArray | None:
        """The nearest place, straight from ``parking``, where the drone stands in nobody's way."""
        axes = self.scene.widest_axes
        angles = np.arange(SPOT_DIRECTIONS) * 2 * np.pi / SPOT_DIRECTIONS
        ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(SPOT_DIRECTIONS)])
        tilted = [ring * np.cos(tilt) + np.array([0.0, 0.0, np.sin(tilt)]) for tilt in (0.0, 0.7, -0.7, 1.4, -1.4)]
        candidates = parking + np.vstack([distance * np.vstack(tilted) for distance in SPOT_RINGS]) * axes
        free = ((candidates >= self.scene.bounds.lower) & (candidates <= self.scene.bounds.upper)).all(axis=1)
        for other in range(self.scene.num_drones):
            for point in (*self._anchors(other), _position(curves[other], np.inf)) if other != drone else ():
                free &= np.logical_not(self._inside(candidates, point, drone, other))
        free = np.logical_and(free, self._straight_ways(drone, parking, candidates))
        return candidates[int(free.argmax())] if free.any() else None

    def _straight_ways(self, drone: int, parking: FloatArray, candidates: FloatArray) -> FloatArray:
        from flockopt.geometry.free_space import segment_clear

        need = self.scene.drones[drone].radius + self.scene.clearance
        slack = distances(self.scene.obstacle_table, parking).min(initial=np.inf) - need
        space = self.scene.free_space(need + max(min(self.reserve_m, 0.5 * slack), 0.0))
        return np.array([segment_clear(space, parking, spot) for spot in candidates])


def _position(curve: tuple[FloatArray, FloatArray], time: float) -> FloatArray:
    """Where a drone is at a time of its own clock, metres; it holds still before and after."""
    breakpoints, coefficients = curve
    inside = min(max(time, breakpoints[0]), breakpoints[-1])
    piece = min(max(int(np.searchsorted(breakpoints, inside, side="right")) - 1, 0), len(coefficients) - 1)
    return np.asarray(coefficients[piece] @ (inside - breakpoints[piece]) ** np.arange(coefficients.shape[2]))
