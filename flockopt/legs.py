"""Compiled: from chains of features to the polylines of legs, shortened, joined where that is shorter, and packed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flockopt.features import Features
from flockopt.geometry import FloatArray
from flockopt.nearness import Space
from flockopt.shortening import polyline_length, shorten

__all__ = ["Drawn", "Legs", "draw", "join", "merge", "pack"]

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


class Drawn(NamedTuple):
    """Polylines of blocked pairs in the making."""

    pairs: NDArray[np.int64]  # (L, 2) smaller index first
    begin: NDArray[np.int64]  # (L,) where a pair's bends begin
    count: NDArray[np.int64]  # (L,) how many there are, -1 where no way is known
    bends: FloatArray  # (room, 3) m
    along: FloatArray  # (room, 3) direction of the edge each bend is around


@njit(cache=True)
def draw(
    space: Space, features: Features, points: FloatArray, pairs: NDArray[np.int64],
    begin: NDArray[np.int64], count: NDArray[np.int64], chains: NDArray[np.int64], lengths: FloatArray,
) -> Drawn:  # fmt: skip
    """The shortened polylines along chains of features; fills ``lengths`` (P, P) where a chain is known."""
    bends, along = np.zeros((chains.shape[0], 3)), np.zeros((chains.shape[0], 3))
    longest = max(count.max(), 0) + 2 if count.shape[0] else 2
    path, edges = np.zeros((longest, 3)), np.zeros((longest, 3))
    for leg in range(pairs.shape[0]):
        if count[leg] < 0:
            continue
        i, j = pairs[leg, 0], pairs[leg, 1]
        size = count[leg] + 2
        path[0], path[size - 1] = points[i], points[j]
        for bend in range(count[leg]):
            feature = chains[begin[leg] + bend]
            path[bend + 1], edges[bend + 1] = features.position[feature], features.along[feature]
        size = shorten(space, path, edges, size)
        lengths[i, j] = lengths[j, i] = polyline_length(path, size)
        count[leg] = size - 2
        bends[begin[leg] : begin[leg] + size - 2] = path[1 : size - 1]
        along[begin[leg] : begin[leg] + size - 2] = edges[1 : size - 1]
    return Drawn(pairs, begin, count, bends, along)


@njit(cache=True)
def _copy(drawn: Drawn, leg: int, backwards: bool, path: FloatArray, edges: FloatArray, size: int) -> int:
    """Append a leg's bends to the first ``size`` vertices of a path; return its new size."""
    for bend in range(drawn.count[leg]):
        at = drawn.begin[leg] + (drawn.count[leg] - 1 - bend if backwards else bend)
        path[size], edges[size] = drawn.bends[at], drawn.along[at]
        size += 1
    return size


@njit(cache=True)
def join(space: Space, points: FloatArray, drawn: Drawn, lengths: FloatArray) -> tuple[Drawn, bool]:
    """Replace each leg that is longer than the way through some third point by that way, shortened.

    Besides mending what sampled features missed, this makes distances obey the triangle inequality more nearly.

    Returns:
        What is drawn now, and whether a pair without a way has got one.
    """
    num_points = points.shape[0]
    pairs, begin, count, bends, along = drawn
    leg_of = np.full((num_points, num_points), -1, dtype=np.int64)
    for leg in range(pairs.shape[0]):
        leg_of[pairs[leg, 0], pairs[leg, 1]] = leg_of[pairs[leg, 1], pairs[leg, 0]] = leg
    used = bends.shape[0]
    found = False
    for leg in range(pairs.shape[0]):
        i, j = pairs[leg, 0], pairs[leg, 1]
        best, through = lengths[i, j] * (1.0 - LEAST_JOIN_GAIN) if count[leg] >= 0 else np.inf, -1
        for k in range(num_points):
            if k != i and k != j and lengths[i, k] + lengths[k, j] < best:
                best, through = lengths[i, k] + lengths[k, j], k
        if through < 0:
            continue
        left, right = leg_of[i, through], leg_of[through, j]
        room = 3 + (count[left] if left >= 0 else 0) + (count[right] if right >= 0 else 0)
        path, edges = np.zeros((room, 3)), np.zeros((room, 3))
        path[0], size = points[i], 1
        if left >= 0:
            size = _copy(Drawn(pairs, begin, count, bends, along), left, through < i, path, edges, size)
        path[size] = points[through]
        size += 1
        if right >= 0:
            size = _copy(Drawn(pairs, begin, count, bends, along), right, j < through, path, edges, size)
        path[size] = points[j]
        size = shorten(space, path, edges, size + 1)
        if used + size > bends.shape[0]:
            bends, along = _wider(bends, used, size), _wider(along, used, size)
        found = found or count[leg] < 0
        lengths[i, j] = lengths[j, i] = polyline_length(path, size)
        begin[leg], count[leg] = used, size - 2
        bends[used : used + size - 2], along[used : used + size - 2] = path[1 : size - 1], edges[1 : size - 1]
        used += size - 2
    return Drawn(pairs, begin, count, bends, along), found


@njit(cache=True)
def _wider(rows: FloatArray, used: int, more: int) -> FloatArray:
    wider = np.zeros((2 * (used + more), 3))
    wider[:used] = rows[:used]
    return wider


def merge(drawn: Drawn, extra: Drawn) -> Drawn:
    """``drawn`` with the ways found in ``extra``, whose pairs are a part of its pairs, in either direction."""
    pairs, begin, count, bends, along = drawn
    begin, count = begin.copy(), count.copy()
    for index in np.flatnonzero(extra.count >= 0):
        i, j = extra.pairs[index]
        leg = np.flatnonzero((pairs == (min(i, j), max(i, j))).all(axis=1))[0]
        rows = slice(extra.begin[index], extra.begin[index] + extra.count[index])
        step = 1 if i < j else -1
        begin[leg], count[leg] = len(bends), extra.count[index]
        bends = np.concatenate([bends, extra.bends[rows][::step]])
        along = np.concatenate([along, extra.along[rows][::step]])
    return Drawn(pairs, begin, count, bends, along)


@njit(cache=True)
def pack(drawn: Drawn) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """The pairs that have a way, their offsets and their bends in one row: see `Legs`."""
    found = np.nonzero(drawn.count >= 0)[0]
    offsets = np.zeros(found.shape[0] + 1, dtype=np.int64)
    for index in range(found.shape[0]):
        offsets[index + 1] = offsets[index] + drawn.count[found[index]]
    bends = np.empty((offsets[-1], 3))
    for index in range(found.shape[0]):
        first = drawn.begin[found[index]]
        bends[offsets[index] : offsets[index + 1]] = drawn.bends[first : first + drawn.count[found[index]]]
    return drawn.pairs[found], offsets, bends
