"""What every law keeps to: a drone's limits and distances, with reserves for rounding, and a Crazyflie's memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockopt.geometry import FloatArray, bounding_boxes, distances
from flockopt.scene import Drone, Scene
from flockopt.trajectory.waypoints import Waypoints

__all__ = ["MOST_PIECES", "Room"]

#: Limits are used to this share, so that rounding never carries a flight over them.
LIMIT_SHARE = 0.999

#: Extra room kept from obstacles where the waypoints have it, metres.
ROOM_RESERVE_M = 1e-3

#: Pieces a Crazyflie's trajectory memory holds; flights are made to fit it where that is possible.
MOST_PIECES = 31


@dataclass(frozen=True)
class Room:
    """What one drone's curve must keep to."""

    table: FloatArray  # (K, 9)
    boxes: FloatArray  # (K, 2, 3) m
    needs: FloatArray  # (K,) m
    lower: FloatArray  # (3,) m
    upper: FloatArray  # (3,) m
    limits: FloatArray  # (3,) speed, acceleration, jerk
    velocity: FloatArray  # (3,) m/s at the start
    acceleration: FloatArray  # (3,) m/s2 at the start

    @classmethod
    def around(cls, scene: Scene, drone: Drone, waypoints: Waypoints, avoided: FloatArray | None = None) -> Room:
        """The room of a drone that follows ``waypoints``, clear of the (K, 9) obstacle rows ``avoided`` too."""
        need = drone.radius + scene.clearance
        table, boxes = scene.obstacle_table, scene.obstacle_boxes
        if avoided is not None and len(avoided):
            table = np.vstack([table, avoided])
            boxes = bounding_boxes(table)
        slack = distances(table, waypoints.points).min(axis=0) - need if len(table) else np.zeros(0)
        return cls(
            table=table,
            boxes=boxes,
            needs=need + np.clip(0.2 * slack, 0.0, ROOM_RESERVE_M),
            lower=np.array(scene.bounds.lower),
            upper=np.array(scene.bounds.upper),
            limits=LIMIT_SHARE * np.array([drone.max_speed, drone.flyable_acceleration, drone.max_jerk]),
            velocity=np.array(drone.velocity),
            acceleration=np.array(drone.acceleration),
        )
