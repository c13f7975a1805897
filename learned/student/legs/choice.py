"""Which of several drawn legs is flown, and how it is pulled taut; compiled.

A leg is judged as the decoder will read it: clear if it still is once vertices next to its chords are dropped.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.geometry.free_space import FreeSpace, polyline_free, segment_free
from flockopt.geometry.polylines import polyline_length, thinned
from flockopt.records.arrays import FloatArray, IntArray

__all__ = ["best_legs", "pull_legs", "rank"]


@compiled_lazily()
def rank(space: FreeSpace, way: FloatArray, tolerance: float) -> float:
    """Metres of a polyline (V, 3) that is clear once thinned by ``tolerance``, else infinite: less is better."""
    return polyline_length(way) if polyline_free(space, thinned(way, tolerance)) else math.inf


@compiled_lazily()
def best_legs(
    space: FreeSpace, leg_end: IntArray, blocked: NDArray[np.bool_], samples: FloatArray, tries: FloatArray,
    tolerance: float,
) -> bool:  # fmt: skip
    """Put the best of some tries into one drone's samples, leg by leg.

    Args:
        space: What the drone keeps clear of.
        leg_end: (T,) and
        blocked: (T,) of the drone, see `learned.student.scenes.examples.Example`.
        samples: (T, 3) m, straight; changed between the anchors of blocked legs.
        tries: (C, T, 3) m, C >= 1, all finite.
        tolerance: Of the thinning, metres.

    Returns:
        Whether all legs are clear.
    """
    all_clear, begin = True, 0
    while begin < len(samples) - 1:
        end = leg_end[begin + 1]
        if blocked[begin + 1]:
            best, least = 0, math.inf
            for index in range(len(tries)):
                samples[begin + 1 : end] = tries[index, begin + 1 : end]
                ranked = rank(space, samples[begin : end + 1], tolerance)
                if ranked < least:
                    best, least = index, ranked
            samples[begin + 1 : end] = tries[best, begin + 1 : end]
            all_clear = all_clear and least < math.inf
        begin = end
    return all_clear


@compiled_lazily()
def pull_legs(space: FreeSpace, leg_end: IntArray, blocked: NDArray[np.bool_], samples: FloatArray, tolerance: float) -> None:
    """Pull one drone's blocked legs taut and thin them, in place; arguments as of `best_legs`.

    The corners that are left come first on each leg, and its end is repeated after them. Thinning a taut leg may cut a
    corner into an obstacle; where the drawn leg only thinned is clear, it takes the taut one's place. Thinned already, a
    leg stays as it is when the decoder thins it.
    """
    begin = 0
    while begin < len(samples) - 1:
        end = leg_end[begin + 1]
        if blocked[begin + 1]:
            drawn = samples[begin : end + 1].copy()
            taut = pulled(space, drawn)
            way = thinned(taut, tolerance)
            if not polyline_free(space, way):
                only_thinned = thinned(drawn, tolerance)
                way = only_thinned if polyline_free(space, only_thinned) else taut
            samples[begin : begin + len(way)] = way
            samples[begin + len(way) : end + 1] = way[-1]
        begin = end


@compiled_lazily()
def pulled(space: FreeSpace, way: FloatArray) -> FloatArray:
    """Vertices of a polyline (V, 3), each the farthest that a clear segment leads to from the one before."""
    kept = [0]
    while kept[-1] < len(way) - 1:
        here, there = kept[-1], len(way) - 1
        while there > here + 1 and not segment_free(space, way[here], way[there]):
            there -= 1
        kept.append(there)
    return way[np.array(kept)]
