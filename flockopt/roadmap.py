"""Shortest any-angle paths among obstacles in 3-D: around, over and under them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from flockopt.features import Features, make_features
from flockopt.geometry import FloatArray
from flockopt.nearness import Space, blocker, make_space
from flockopt.shortening import polyline_length, shorten
from flockopt.pathsearch import shortest, within_ellipse
from flockopt.visibility import Sight, empty_sight, segment_length

__all__ = ["Legs", "Roadmap"]

#: Ellipses to search first, as multiples of the straight flight.
ELLIPSES = (1.02, 1.1)


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


class Roadmap:
    """Paths for one kind of drone among fixed obstacles.

    Features are made and looked around from only when a straight flight is blocked, and what was found is kept
    for later queries.

    Args:
        table: (K, 9) obstacles, see `flockopt.geometry.OBSTACLE_COLUMNS`.
        needs: (K,) m, least distance of the drone's centre from each obstacle.
        bounds: (2, 3) m or (lower, upper): the space paths stay within.
    """

    def __init__(self, table: FloatArray, needs: ArrayLike, bounds: ArrayLike) -> None:
        lower, upper = np.asarray(bounds, dtype=np.float64)
        self._space: Space = make_space(table, np.asarray(needs, dtype=np.float64), lower, upper)
        self._features: Features | None = None
        self._sight: Sight | None = None

    def path(self, p: ArrayLike, q: ArrayLike) -> tuple[float, FloatArray]:
        """Length, metres, and vertices (V, 3) of a shortest path; infinite and none where there is no way."""
        points = np.array([p, q], dtype=np.float64)
        legs = self.legs(points, np.array([[False, True], [False, False]]))
        length = float(legs.lengths[0, 1])
        if math.isinf(length):
            return length, np.empty((0, 3))
        return length, np.concatenate([points[:1], legs.bends, points[1:]])

    def legs(self, points: FloatArray, wanted: NDArray[np.bool_]) -> Legs:
        """Paths between all pairs i < j of ``points`` (P, 3) with ``wanted[i, j]`` (P, P)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        lengths, blocked = _straight(self._space, points, wanted)
        if not blocked.any():
            return Legs(lengths, np.empty((0, 2), dtype=np.int64), np.zeros(1, dtype=np.int64), np.empty((0, 3)))
        if self._features is None or self._sight is None:
            self._features = make_features(self._space)
            self._sight = empty_sight(len(self._features.position))
        self._sight, pairs, offsets, bends = _bent(self._space, self._features, self._sight, points, blocked, lengths)
        return Legs(lengths, pairs, offsets, bends)


@njit(cache=True)
def _straight(space: Space, points: FloatArray, wanted: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Lengths of the clear straight flights, and which of the wanted ones are blocked."""
    num_points = points.shape[0]
    lengths = np.full((num_points, num_points), np.inf)
    blocked = np.zeros((num_points, num_points), dtype=np.bool_)
    for i in range(num_points):
        guess = -1
        lengths[i, i] = 0.0
        for j in range(i + 1, num_points):
            if wanted[i, j]:
                found = blocker(space, points[i], points[j], guess)
                if found < 0:
                    lengths[i, j] = lengths[j, i] = segment_length(points[i], points[j])
                else:
                    blocked[i, j] = True
                    guess = found
    return lengths, blocked


@njit(cache=True)
def _bent(
    space: Space, features: Features, sight: Sight, points: FloatArray, blocked: NDArray[np.bool_], lengths: FloatArray
) -> tuple[Sight, NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Shortest paths for the blocked pairs; fills ``lengths`` and returns the fields of `Legs`."""
    num_points, num_features = points.shape[0], features.position.shape[0]
    views = np.zeros((num_points, num_features), dtype=np.uint8)
    parent = np.empty(num_features, dtype=np.int64)
    from_source = np.empty(num_features)
    path, along = np.zeros((num_features + 2, 3)), np.zeros((num_features + 2, 3))
    pairs = np.argwhere(blocked)
    offsets = np.zeros(pairs.shape[0] + 1, dtype=np.int64)
    bends = np.empty((4 * pairs.shape[0] + 16, 3))
    begin, count_of = np.empty(pairs.shape[0], dtype=np.int64), np.full(pairs.shape[0], -1, dtype=np.int64)
    used, pair = 0, 0
    left = np.empty(num_points, dtype=np.int64)
    while pair < pairs.shape[0]:
        source = pairs[pair, 0]
        stop = pair
        while stop < pairs.shape[0] and pairs[stop, 0] == source:
            stop += 1
        for v in range(num_features):
            from_source[v] = segment_length(points[source], features.position[v])
        num_left = 0
        for index in range(pair, stop + 1):
            if index < stop:
                target = pairs[index, 1]
                straight = segment_length(points[source], points[target])
                last = -1
                for share in ELLIPSES:
                    length, last = within_ellipse(
                        space, features, points, views, source, target, from_source, share * straight, parent
                    )
                    if last >= 0:
                        break
                if last < 0:
                    left[num_left] = index
                    num_left += 1
                    continue
                used, bends = _keep(space, features, points, source, target, last, parent, path, along, bends, used, lengths, begin, count_of, index)
            elif num_left > 0:
                targets = pairs[left[:num_left], 1]
                best = np.full(num_left, np.inf)
                lasts = np.full(num_left, -1, dtype=np.int64)
                sight = shortest(space, features, sight, points, views, source, targets, best, lasts, parent)
                for t in range(num_left):
                    if lasts[t] >= 0:
                        used, bends = _keep(space, features, points, source, targets[t], lasts[t], parent, path, along, bends, used, lengths, begin, count_of, left[t])
        pair = stop
    # pack the found ones in the order of the pairs
    found = np.nonzero(count_of >= 0)[0]
    packed = np.empty((used, 3))
    offsets = np.zeros(found.shape[0] + 1, dtype=np.int64)
    for i in range(found.shape[0]):
        b, c = begin[found[i]], count_of[found[i]]
        offsets[i + 1] = offsets[i] + c
        packed[offsets[i] : offsets[i + 1]] = bends[b : b + c]
    return sight, pairs[found], offsets, packed


@njit(cache=True)
def _keep(space, features, points, source, target, last, parent, path, along, bends, used, lengths, begin, count_of, index):
    count = _trace(features, points[source], points[target], last, parent, path, along)
    count = shorten(space, path, along, count)
    lengths[source, target] = lengths[target, source] = polyline_length(path, count)
    if used + count > bends.shape[0]:
        wider = np.empty((2 * (used + count), 3))
        wider[:used] = bends[:used]
        bends = wider
    bends[used : used + count - 2] = path[1 : count - 1]
    begin[index], count_of[index] = used, count - 2
    return used + count - 2, bends


@njit(cache=True)
def _trace(
    features: Features, start: FloatArray, goal: FloatArray, last: int, parent: NDArray[np.int64],
    path: FloatArray, along: FloatArray,
) -> int:  # fmt: skip
    """Write the path start-features-goal into ``path`` and its edges into ``along``; return its vertex count."""
    count = 2
    u = last
    while u >= 0:
        count += 1
        u = parent[u]
    path[0], path[count - 1] = start, goal
    u = last
    for i in range(count - 2, 0, -1):
        path[i], along[i] = features.position[u], features.along[u]
        u = parent[u]
    return count
