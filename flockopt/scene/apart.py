"""Places at which drones come to rest for good: they are as far apart as the drones must be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockopt.records.arrays import FloatArray
from flockopt.scene.parts import Drone
from flockopt.scene.scene import Scene

__all__ = ["is_grounded", "least_resting_share", "shares_apart"]


def is_grounded(drone: Drone) -> bool:
    """Whether a drone never moves: it can serve nothing, has nowhere to go, and is at rest."""
    return drone.capacity == 0 and drone.end is None and not any((*drone.velocity, *drone.acceleration))


def shares_apart(scene: Scene, i: int, here: FloatArray, j: int, there: FloatArray) -> FloatArray:
    """How far drone i at ``here`` is from drone j at each of ``there`` (P, 3), as shares (P,) of what must be kept."""
    shares: FloatArray = np.linalg.norm((there - here) / scene.axes_between(i, j), axis=1)
    return shares


def least_resting_share(scene: Scene) -> float:
    """How near two drones come for good, at ends and where grounded ones stand, as a share of what must be kept."""
    places = scene.ends.copy()
    grounded = [i for i, drone in enumerate(scene.drones) if is_grounded(drone)]
    places[grounded] = scene.starts[grounded]
    resting = np.flatnonzero(~np.isnan(places[:, 0]))
    later = list(enumerate(resting.tolist()))[1:]
    return min((float(_shares(scene, places, resting[:rank], i).min()) for rank, i in later), default=np.inf)


def _shares(scene: Scene, places: FloatArray, others: NDArray[np.int64], i: int) -> FloatArray:
    """How far each of some drones is from drone i at these places (N, 3), as shares of what must be kept."""
    shares: FloatArray = np.linalg.norm((places[others] - places[i]) / scene.axes_between(others, i), axis=1)
    return shares
