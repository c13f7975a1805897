"""What every law keeps to: a drone's limits and distances, with reserves for rounding, and a Crazyflie's memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flockopt.flights.waypoints import Waypoints
from flockopt.geometry.distances import distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene

if TYPE_CHECKING:
    from flockopt.geometry.free_space import FreeSpace

__all__ = ["MOST_PIECES", "Room"]

#: Limits are used to this share, so that rounding never carries a flight over them.
LIMIT_SHARE = 0.999

#: Extra room kept from obstacles where the waypoints have it, metres.
ROOM_RESERVE_M = 1e-3

#: For small drones that is less: at most this share of what they keep from obstacles.
ROOM_RESERVE_SHARE = 0.01

#: Pieces a Crazyflie's trajectory memory holds; flights are made to fit it where that is possible.
MOST_PIECES = 31


@dataclass(frozen=True)
class Room:
    """What one drone's curve must keep to."""

    space: FreeSpace
    limits: FloatArray  # (3,) speed, acceleration, jerk
    velocity: FloatArray  # (3,) m/s at the start
    acceleration: FloatArray  # (3,) m/s2 at the start

    @property
    def in_motion(self) -> bool:
        """Whether the drone already flies at the start."""
        return bool(self.velocity.any() or self.acceleration.any())

    @classmethod
    def around(cls, scene: Scene, drone: Drone, waypoints: Waypoints, avoided: FloatArray | None = None) -> Room:
        """The room of a drone that follows ``waypoints``, clear of the (K, 9) obstacle rows ``avoided`` too."""
        table = scene.obstacle_table if avoided is None else np.vstack([scene.obstacle_table, avoided])
        return cls._within(scene, drone, table, distances(table, waypoints.points).min(axis=0))

    @classmethod
    def of_fleet(cls, scene: Scene, ways: Mapping[int, Waypoints]) -> dict[int, Room]:
        """The rooms of several drones, by index, as from `around`."""
        points = [waypoints.points for waypoints in ways.values()]
        gaps = distances(scene.obstacle_table, np.concatenate(points) if points else np.empty((0, 3)))  # (P, K)
        first = np.concatenate([[0], np.cumsum([len(part) for part in points], dtype=np.int64)])[:-1]
        least = np.minimum.reduceat(gaps, first, axis=0) if points else gaps
        return {
            index: cls._within(scene, scene.drones[index], scene.obstacle_table, row)
            for index, row in zip(ways, least, strict=True)
        }

    @classmethod
    def _within(cls, scene: Scene, drone: Drone, table: FloatArray, gaps: FloatArray) -> Room:
        """The room of a drone whose waypoints come within ``gaps`` (K,) m of the obstacles in ``table`` (K, 9)."""
        from flockopt.geometry.free_space import free_space

        need = drone.radius + scene.clearance
        needs = need + np.clip(0.2 * (gaps - need), 0.0, min(ROOM_RESERVE_M, ROOM_RESERVE_SHARE * need))
        return cls(
            space=free_space(table, needs, (scene.bounds.lower, scene.bounds.upper)),
            limits=LIMIT_SHARE * np.array([drone.max_speed, drone.flyable_acceleration, drone.max_jerk]),
            velocity=np.array(drone.velocity),
            acceleration=np.array(drone.acceleration),
        )
