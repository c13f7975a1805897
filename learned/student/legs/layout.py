"""Where samples lie along a drone's straight legs, compiled; see `learned.student.scenes.examples`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.geometry.free_space import FreeSpace, segment_free
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray, IntArray

__all__ = ["CLEAR_SHARE", "lay_out"]

#: A leg whose straight line is clear gets this share of the samples that its length would bring it.
CLEAR_SHARE = 0.25


@compiled_lazily()
def lay_out(space: FreeSpace, anchors: FloatArray, straight: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Legs and samples of one drone.

    Args:
        space: What it keeps clear of.
        anchors: (A, 3) m, 2 <= A <= T.
        straight: (T, 3) m, filled with the samples.

    Returns:
        (3, T) each sample's leg and the samples of that leg's anchors, and (T,) whether the leg is blocked.
    """
    num_legs, num_samples = len(anchors) - 1, len(straight)
    legs, blocked = np.zeros((3, num_samples), dtype=np.int64), np.zeros(num_samples, dtype=np.bool_)
    is_blocked, weights = np.zeros(num_legs, dtype=np.bool_), np.empty(num_legs)
    for leg in range(num_legs):
        is_blocked[leg] = not segment_free(space, anchors[leg], anchors[leg + 1])
        weights[leg] = segment_length(anchors[leg], anchors[leg + 1]) * (1.0 if is_blocked[leg] else CLEAR_SHARE)
    places = anchor_places(weights, num_samples)
    for leg in range(num_legs):
        begin, end = places[leg], places[leg + 1]
        for sample in range(begin + (leg > 0), end + 1):  # a task's sample counts to the leg that ends there
            legs[0, sample], legs[1, sample], legs[2, sample] = leg, begin, end
            blocked[sample] = is_blocked[leg]
            straight[sample] = anchors[leg] + (sample - begin) / (end - begin) * (anchors[leg + 1] - anchors[leg])
        straight[begin], straight[end] = anchors[leg], anchors[leg + 1]
    return legs, blocked


@compiled_lazily()
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
