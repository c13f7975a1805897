"""Legs between places: lengths of shortest paths, and their bends in one row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.records.arrays import FloatArray

__all__ = ["Legs", "legs_of"]


@dataclass(frozen=True, eq=False)
class Legs:
    """Shortest paths between the wanted pairs of some points.

    Attributes:
        lengths: (P, P) m, symmetric; infinite where there is no way or the pair was not wanted.
        pairs: (L, 2) the pairs, smaller index first, in rising order, whose path bends.
        offsets: (L + 1,) where each pair's bends begin in ``bends``.
        bends: (B, 3) m, inner vertices from the smaller index to the larger.
    """

    lengths: FloatArray
    pairs: NDArray[np.int64]
    offsets: NDArray[np.int64]
    bends: FloatArray

    def with_more(self, more: Legs) -> Legs:
        """These legs, and others between pairs that have none here."""
        if not np.isfinite(more.lengths[np.isinf(self.lengths)]).any():
            return self
        counts = np.concatenate([np.diff(self.offsets), np.diff(more.offsets)])
        begin = np.concatenate([self.offsets[:-1], more.offsets[:-1] + len(self.bends)])
        pairs, bends = np.concatenate([self.pairs, more.pairs]), np.concatenate([self.bends, more.bends])
        return legs_of(np.minimum(self.lengths, more.lengths), pairs, begin, counts, bends)


def legs_of(
    lengths: FloatArray, pairs: NDArray[np.int64], begin: NDArray[np.int64], count: NDArray[np.int64], bends: FloatArray
) -> Legs:
    """The legs of pairs (L, 2), each with ``count`` bends from where it begins among ``bends`` (B, 3) m, put in order.

    Those of a pair whose larger index stands first are turned round.
    """
    ends = np.sort(pairs, axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    step = np.where(pairs[order, 0] < pairs[order, 1], 1, -1)
    begin, count = begin[order], count[order]
    offsets = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(count)])
    place = np.arange(offsets[-1]) - np.repeat(offsets[:-1], count)
    rows = np.repeat(np.where(step > 0, begin, begin + count - 1), count) + place * np.repeat(step, count)
    return Legs(lengths, ends[order], offsets, bends[rows])
