"""Places at which drones come to rest for good: they are as far apart as the drones must be."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from flockopt.errors import SceneError
from flockopt.records.arrays import FloatArray

if TYPE_CHECKING:
    from flockopt.scene.scene import Scene

__all__ = ["axes_between", "check_ends_apart", "least_apart", "shares_apart"]

#: What rounding may take of the distance that must be kept.
ROUNDING = 1e-9


def axes_between(scene: Scene, i: int, j: int) -> FloatArray:
    """Half axes of the ellipsoid around drone i that the centre of drone j stays out of, (3,) m.

    The separation of the scene, and at least what keeps their bodies from overlapping.
    """
    bodies = scene.drones[i].radius + scene.drones[j].radius
    return np.maximum(np.array(scene.separation_axes), bodies)


def shares_apart(scene: Scene, i: int, here: FloatArray, j: int, there: FloatArray) -> FloatArray:
    """How far drone i at ``here`` is from drone j at each of ``there`` (P, 3), as shares (P,) of what must be kept."""
    shares: FloatArray = np.linalg.norm((there - here) / axes_between(scene, i, j), axis=1)
    return shares


def least_apart(scene: Scene, i: int, j: int) -> str:
    """What two drones must keep, in words."""
    bodies = scene.drones[i].radius + scene.drones[j].radius
    if max(scene.separation_axes) <= bodies:
        return f"at least the sum of their radii ({bodies:g} m)"
    tall = "" if scene.separation_z is None else f", {axes_between(scene, i, j)[2]:g} m upwards"
    return f"at least the separation ({axes_between(scene, i, j)[0]:g} m{tall})"


def check_ends_apart(scene: Scene) -> None:
    """Refuse two ends, those at drones' starts included, at which both drones cannot rest."""
    with_end = [i for i, drone in enumerate(scene.drones) if drone.end is not None]
    ends = scene.ends[with_end]
    for rank, i in enumerate(with_end[1:], start=1):
        near = np.linalg.norm(ends[:rank] - ends[rank], axis=1) < _widest(scene, i)
        for other in np.flatnonzero(near):
            j = with_end[other]
            if shares_apart(scene, i, ends[rank], j, ends[other : other + 1])[0] < 1.0 - ROUNDING:
                raise SceneError(
                    f"drones[{i}].end", f"is {math.dist(ends[rank], ends[other]):.4g} m from drones[{j}].end",
                    f"ends must be {least_apart(scene, i, j)} apart, for both drones rest there", "move one of them",
                )  # fmt: skip


def _widest(scene: Scene, i: int) -> float:
    """No other drone must keep farther from drone i than this, metres."""
    return max(*scene.separation_axes, scene.drones[i].radius + float(scene.radii.max()))
