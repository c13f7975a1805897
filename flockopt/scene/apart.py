"""Places at which drones come to rest for good: they are as far apart as the drones must be."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SceneError
from flockopt.records.arrays import FloatArray

if TYPE_CHECKING:
    from flockopt.scene.parts import Drone
    from flockopt.scene.scene import Scene

__all__ = ["check_ends_apart", "is_grounded", "least_apart", "least_resting_share", "shares_apart"]

#: What rounding may take of the distance that must be kept.
ROUNDING = 1e-9


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


def least_apart(scene: Scene, i: int, j: int) -> str:
    """What two drones must keep, in words."""
    flat, _, tall = scene.axes_between(i, j)
    if flat > scene.separation:
        return f"at least the sum of their radii ({flat:g} m)"
    return f"at least the separation ({flat:g} m{'' if tall == flat else f', {tall:g} m upwards'})"


def check_ends_apart(scene: Scene) -> None:
    """Refuse two ends, those at drones' starts included, at which both drones cannot rest."""
    with_end = np.flatnonzero(~np.isnan(scene.ends[:, 0]))
    for rank, i in list(enumerate(with_end.tolist()))[1:]:
        shares = _shares(scene, scene.ends, with_end[:rank], i)
        if shares.min() < 1.0 - ROUNDING:
            j = int(with_end[int(shares.argmin())])
            raise SceneError(
                f"drones[{i}].end", f"is {math.dist(scene.ends[i], scene.ends[j]):.4g} m from drones[{j}].end",
                f"ends must be {least_apart(scene, i, j)} apart, for both drones rest there", "move one of them",
            )  # fmt: skip
