"""Drawn ways pulled taut: corners that a clear shortcut spares are dropped.

What a network draws wavers by centimetres, and a flight slows down at every bend. No path is searched for: of the drawn
samples some are kept, in order.
"""

from __future__ import annotations

import numpy as np

from flockopt.geometry import FloatArray
from flockopt.trajectory.waypoints import leg_clear
from learned.student.examples import Example

__all__ = ["pulled_samples"]


def pulled_samples(one: Example, samples: FloatArray) -> FloatArray:
    """Samples (N, T, 3) m with the legs pulled taut whose straight line is blocked; their anchors stay in place.

    The corners that are left come first on each leg, and its end is repeated after them.
    """
    result = samples.copy()
    for drone in np.flatnonzero(one.blocked.any(axis=1)):
        for leg in np.unique(one.leg_index[drone][one.blocked[drone]]):
            at = np.flatnonzero(one.leg_index[drone] == leg)[-1]
            first, last = one.leg_begin[drone, at], one.leg_end[drone, at]
            way = _pulled(one, int(drone), samples[drone, first : last + 1])
            result[drone, first : first + len(way)] = way
            result[drone, first + len(way) : last + 1] = way[-1]
    return result


def _pulled(one: Example, drone: int, way: FloatArray) -> FloatArray:
    """Vertices of a polyline (V, 3), each the farthest that a clear segment leads to from the one before."""
    kept = [0]
    while kept[-1] < len(way) - 1:
        here = kept[-1]
        reach = (there for there in range(len(way) - 1, here, -1) if leg_clear(one.scene, drone, way[[here, there]]))
        kept.append(next(reach, here + 1))
    return way[kept]
