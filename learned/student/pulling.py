"""Drawn ways pulled taut: corners that a clear shortcut spares are dropped.

What a network draws wavers by centimetres, and a flight slows down at every bend. No path is searched for: of the drawn
samples some are kept, in order.
"""

from __future__ import annotations

import numpy as np

from flockopt.flights.waypoints import CHORD_TOLERANCE
from flockopt.records.arrays import FloatArray
from learned.student.legs.choice import pull_legs
from learned.student.scenes.examples import Example

__all__ = ["pulled_samples", "ways_of"]


def pulled_samples(one: Example, samples: FloatArray) -> FloatArray:
    """Samples (N, T, 3) m with the legs pulled taut whose straight line is blocked; their anchors stay in place.

    The corners that are left come first on each leg, and its end is repeated after them.
    """
    result = samples.copy()
    for drone in np.flatnonzero(one.is_blocked):
        radius = one.scene.drones[drone].radius
        tolerance, space = CHORD_TOLERANCE * radius, one.scene.free_space(radius + one.scene.clearance)
        pull_legs(space, one.leg_end[drone], one.blocked[drone], result[drone], tolerance)
    return result


def ways_of(one: Example, samples: FloatArray) -> list[FloatArray]:
    """Each drone's polyline (V, 3) m through its anchors, and on the legs whose straight line is blocked its samples.

    Samples (N, T, 3) m are as `pulled_samples` leaves them.
    """
    kept = one.blocked.copy()
    for places in (one.leg_begin, one.leg_end):
        np.put_along_axis(kept, places, True, axis=1)
    kept[:, 1:] &= (samples[:, 1:] != samples[:, :-1]).any(axis=2)
    return [way[is_kept] for way, is_kept in zip(samples, kept, strict=True)]
