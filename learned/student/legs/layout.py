"""Where samples lie along a drone's straight legs, compiled; see `learned.student.scenes.examples`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flockopt.records.arrays import FloatArray, IntArray
from learned.student.legs.clearance import Obstructions, segment_is_clear

__all__ = ["CLEAR_SHARE", "lay_out"]

#: A leg whose straight line is clear gets this share of the samples that its length would bring it.
CLEAR_SHARE = 0.25


@njit(cache=True)
def lay_out(
    space: Obstructions, anchors: FloatArray, offsets: IntArray, straight: FloatArray
) -> tuple[IntArray, NDArray[np.bool_]]:
    """Legs and samples of a whole fleet.

    Args:
        space: What to keep clear of.
        anchors: (A, 3) m, all drones' anchors one after another.
        offsets: (N + 1,) where each drone's begin; at most T anchors each.
        straight: (N, T, 3) m, filled with the samples where a drone has legs, and left as it is where it has none.

    Returns:
        (3, N, T) each sample's leg and the samples of that leg's anchors, and (N, T) whether the leg is blocked.
    """
    num_drones, num_samples = straight.shape[:2]
    legs = np.zeros((3, num_drones, num_samples), dtype=np.int64)
    blocked = np.zeros((num_drones, num_samples), dtype=np.bool_)
    for drone in range(num_drones):
        own = anchors[offsets[drone] : offsets[drone + 1]]
        if len(own) < 2:
            continue
        is_blocked = np.zeros(len(own) - 1, dtype=np.bool_)
        weights = np.empty(len(own) - 1)
        for leg in range(len(own) - 1):
            is_blocked[leg] = not segment_is_clear(space, drone, own[leg], own[leg + 1])
            step = own[leg + 1] - own[leg]
            weights[leg] = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) * (1.0 if is_blocked[leg] else CLEAR_SHARE)
        places = anchor_places(weights, num_samples)
        for leg in range(len(own) - 1):
            begin, end = places[leg], places[leg + 1]
            for sample in range(begin + (leg > 0), end + 1):  # a task's sample counts to the leg that ends there
                legs[0, drone, sample], legs[1, drone, sample], legs[2, drone, sample] = leg, begin, end
                blocked[drone, sample] = is_blocked[leg]
                straight[drone, sample] = own[leg] + (sample - begin) / (end - begin) * (own[leg + 1] - own[leg])
            straight[drone, begin], straight[drone, end] = own[leg], own[leg + 1]
    return legs, blocked


@njit(cache=True)
def anchor_places(weights: FloatArray, num_samples: int) -> IntArray:
    """(L + 1,) the samples of the anchors: rising from the first to the last, spaced by the legs' weights (L,)."""
    total, places = max(weights.sum(), 1e-9), np.zeros(len(weights) + 1, dtype=np.int64)
    flown, latest = 0.0, 0
    for leg in range(len(weights)):
        flown += weights[leg]
        latest = max(latest, int(np.rint(flown / total * (num_samples - 1))) - (leg + 1))
        places[leg + 1] = latest + leg + 1
    places[-1] = num_samples - 1  # also where all legs lead nowhere
    for index in range(len(places)):
        places[index] = min(places[index], num_samples - len(places) + index)
    return places
