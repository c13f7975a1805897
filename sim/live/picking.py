"""Places that someone has clicked or typed."""

from __future__ import annotations

import math

import numpy as np

from flockopt.errors import SettingsError
from flockopt.geometry.distances import distances
from flockopt.scene import Point, Scene

__all__ = ["first_hit", "typed_point"]

#: A ray has hit what it is this near to, metres, and is given up after this many steps.
HIT_M, MOST_STEPS = 1e-3, 500


def typed_point(words: str) -> Point:
    """The point that someone has typed: three numbers between commas or spaces.

    Raises:
        SettingsError: If that is not what they are.
    """
    try:
        x, y, z = (float(word) for word in words.replace(",", " ").split())
    except ValueError:
        raise SettingsError(
            "place", f"is {words!r}", "must be three numbers: x, y and z in metres", "type 1.5, 2, 0.8"
        ) from None
    return x, y, z


def first_hit(scene: Scene, origin: Point, direction: Point) -> Point:
    """Where a ray first meets an obstacle or the floor, metres, to a millimetre.

    Args:
        scene: The scene; its floor is the lower side of its bounds.
        origin: Of the ray, m.
        direction: Of the ray; any length.

    Raises:
        SettingsError: If it leaves the scene before.
    """
    lower, upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    onward = np.array(direction) / np.linalg.norm(direction)
    place, reach = np.array(origin, dtype=np.float64), float(np.linalg.norm(upper - lower))
    for _ in range(MOST_STEPS):
        fall = (place[2] - lower[2]) / -onward[2] if onward[2] < 0.0 else math.inf
        step = min(fall, float(distances(scene.obstacle_table, place)[0].min(initial=math.inf)))  # no obstacle is nearer
        if step < HIT_M:
            break
        place = place + min(step, reach) * onward
    if step >= HIT_M or (place[:2] < lower[:2]).any() or (place[:2] > upper[:2]).any():
        raise SettingsError("click", "leads out of the scene", "must lead to the floor or an obstacle", "click on one of them")
    return round(float(place[0]), 3), round(float(place[1]), 3), round(float(place[2]), 3)
