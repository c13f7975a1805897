"""Legs between points: polylines along chains of features, shortened, joined where that is shorter, and packed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_2, INTEGERS_2, compiled_for
from flockopt.batches.deadline import Deadline
from flockopt.geometry.free_space import FreeSpace
from flockopt.records.arrays import FloatArray
from flockopt.travel.shortening import shorten

__all__ = ["DOING", "FIRST_PAIRS", "Drawn", "Legs", "draw", "join", "merge", "pack"]

#: What it does, for those who give it a deadline; pairs of points before the clock is read first.
DOING, FIRST_PAIRS = "finding ways among obstacles", 64

#: A way through a third point replaces a leg if it is shorter by this share.
LEAST_JOIN_GAIN = 1e-6


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
        pairs = np.concatenate([self.pairs, more.pairs])
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        bends = [part for legs in (self, more) for part in np.split(legs.bends, legs.offsets[1:-1])[: len(legs.pairs)]]
        sizes = [len(bends[leg]) for leg in order]
        return Legs(
            np.minimum(self.lengths, more.lengths),
            pairs[order],
            np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]),
            np.concatenate([np.empty((0, 3)), *(bends[leg] for leg in order)]),
        )


@dataclass(frozen=True, eq=False)
class Drawn:
    """Polylines in the making, each between a pair of points."""

    pairs: NDArray[np.int64]  # (L, 2) from, to
    begin: NDArray[np.int64]  # (L,) where a pair's bends begin
    count: NDArray[np.int64]  # (L,) how many there are, -1 where no way is known
    bends: FloatArray  # (B, 3) m
    along: FloatArray  # (B, 3) unit direction of the edge a bend is around, zero where none

    @property
    def missing(self) -> NDArray[np.bool_]:
        """(L,) whether no way is known."""
        return self.count < 0

    def rows(self, leg: int, backwards: bool = False) -> NDArray[np.int64]:
        """Where the bends of a leg are."""
        rows = np.arange(self.begin[leg], self.begin[leg] + self.count[leg])
        return rows[::-1] if backwards else rows


def draw(space: FreeSpace, points: FloatArray, drawn: Drawn, lengths: FloatArray, deadline: Deadline) -> Drawn:
    """``drawn``, shortened; fills ``lengths`` (P, P)."""
    count, bends, along = drawn.count.copy(), drawn.bends.copy(), drawn.along.copy()
    result = np.empty(len(count))
    for first, last in deadline.slices(len(count), DOING, FIRST_PAIRS):
        pairs, begin, left = drawn.pairs[first:last], drawn.begin[first:last], count[first:last]
        result[first:last] = shorten(space, points, pairs, begin, left, bends, along)
    first, second = drawn.pairs.T
    lengths[first, second] = lengths[second, first] = result
    return Drawn(drawn.pairs, drawn.begin, count, bends, along)


def join(space: FreeSpace, points: FloatArray, drawn: Drawn, lengths: FloatArray, deadline: Deadline) -> Drawn:
    """Replace each leg that is longer than the way through some third point by that way, shortened.

    Besides mending what sampled features missed, this brings distances nearer to the triangle inequality.
    """
    slices = deadline.slices(len(drawn.pairs), DOING, FIRST_PAIRS)
    through = np.concatenate([_shorter_through(lengths, drawn.pairs[first:last]) for first, last in slices])
    legs = np.flatnonzero(through >= 0)
    if not len(legs):
        return drawn
    leg_of = {(int(i), int(j)): leg for leg, (i, j) in enumerate(drawn.pairs)}

    def bends_of(i: int, j: int) -> tuple[FloatArray, FloatArray]:
        leg = leg_of.get((min(i, j), max(i, j)))
        if leg is None:
            return np.empty((0, 3)), np.empty((0, 3))
        rows = drawn.rows(leg, backwards=i > j)
        return drawn.bends[rows], drawn.along[rows]

    bends, along, count = [], [], []
    for leg in legs:
        (i, j), k = drawn.pairs[leg], through[leg]
        (left, left_along), (right, right_along) = bends_of(i, k), bends_of(k, j)
        bends += [left, points[k : k + 1], right]
        along += [left_along, np.zeros((1, 3)), right_along]
        count.append(len(left) + 1 + len(right))
    sizes = np.array(count, dtype=np.int64)
    joined = Drawn(drawn.pairs[legs], np.cumsum(sizes) - sizes, sizes, np.concatenate(bends), np.concatenate(along))
    return merge(drawn, draw(space, points, joined, lengths, deadline))


@compiled_for(FLOATS_2, INTEGERS_2, error_model="numpy")
def _shorter_through(lengths: FloatArray, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """The third point through which each pair's way is shortest, (L,), -1 where no third point makes it shorter."""
    through = np.full(pairs.shape[0], -1, dtype=np.int64)
    for leg in range(pairs.shape[0]):
        i, j = pairs[leg, 0], pairs[leg, 1]
        best = lengths[i, j] * (1.0 - LEAST_JOIN_GAIN)
        for k in range(lengths.shape[0]):
            if k != i and k != j and lengths[i, k] + lengths[j, k] < best:
                best, through[leg] = lengths[i, k] + lengths[j, k], k
    return through


def merge(drawn: Drawn, extra: Drawn) -> Drawn:
    """``drawn`` with the ways found in ``extra``, whose pairs are some of its pairs, in either direction."""
    begin, count, bends, along = drawn.begin.copy(), drawn.count.copy(), [drawn.bends], [drawn.along]
    leg_of = {(int(i), int(j)): leg for leg, (i, j) in enumerate(drawn.pairs)}
    used = len(drawn.bends)
    for index in map(int, np.flatnonzero(~extra.missing)):
        i, j = (int(end) for end in extra.pairs[index])
        leg, rows = leg_of[min(i, j), max(i, j)], extra.rows(index, backwards=i > j)
        begin[leg], count[leg] = used, len(rows)
        bends.append(extra.bends[rows])
        along.append(extra.along[rows])
        used += len(rows)
    return Drawn(drawn.pairs, begin, count, np.concatenate(bends), np.concatenate(along))


def pack(drawn: Drawn, lengths: FloatArray) -> Legs:
    """The legs that have a way, with their bends in one row."""
    found = np.flatnonzero(~drawn.missing)
    count = drawn.count[found]
    offsets = np.concatenate([[0], np.cumsum(count)])
    rows = np.arange(offsets[-1]) + np.repeat(drawn.begin[found] - offsets[:-1], count)
    return Legs(lengths, drawn.pairs[found], offsets, drawn.bends[rows])
