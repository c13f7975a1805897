"""Shortest any-angle paths among obstacles in 3-D: around, over and under them."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from numba import types
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components

from flockopt.batches.compiled import FLOATS_2, INTEGERS_1, INTEGERS_2, compiled_for, writable
from flockopt.batches.deadline import NEVER, Deadline, heard
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace, free_space
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import FEATURES, Features, make_features, unrestricted
from flockopt.travel.blocking import blocked_pairs
from flockopt.travel.legs import DOING, FIRST_PAIRS, Drawn, Legs, draw, join, merge, pack
from flockopt.travel.path_search import shortest, within_ellipse
from flockopt.travel.sight import SIGHT, Sight, View, empty_sight

__all__ = ["Legs", "Roadmap"]

#: Among up to so many obstacles, features are made too soon to be interrupted.
FEW_OBSTACLES = 300

#: Ellipses to search first, as multiples of the straight flight.
ELLIPSES = (1.02, 1.1)


class Roadmap:
    """Paths for one kind of drone among fixed obstacles.

    Features are made only when a straight flight is blocked, and what they see is found only as far as a search
    gets; both are kept for later queries.

    Args:
        table: (K, 9) obstacles, see `flockopt.geometry.distances.OBSTACLE_COLUMNS`.
        needs: (K,) m, least distance of the drone's centre from each obstacle.
        bounds: (2, 3) m or (lower, upper): the space paths stay within.
    """

    def __init__(self, table: FloatArray, needs: ArrayLike, bounds: ArrayLike) -> None:
        self._space = free_space(table, needs, bounds)
        self._features: Features | None = None
        self._sight: Sight | None = None

    def path(self, p: ArrayLike, q: ArrayLike, deadline: Deadline = NEVER) -> tuple[float, FloatArray]:
        """Length, metres, and vertices (V, 3) of a shortest path; infinite and none where there is no way."""
        points = np.array([p, q], dtype=np.float64)
        legs = self.legs(points, np.array([[False, True], [False, False]]), deadline)
        length = float(legs.lengths[0, 1])
        if math.isinf(length):
            return length, np.empty((0, 3))
        return length, np.concatenate([points[:1], legs.bends, points[1:]])

    def legs(self, points: FloatArray, wanted: NDArray[np.bool_], deadline: Deadline = NEVER) -> Legs:
        """Paths between all pairs i < j of ``points`` (P, 3) with ``wanted[i, j]`` (P, P).

        Raises:
            OutOfTime: If the deadline passes.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        pairs = np.ascontiguousarray(np.argwhere(np.triu(wanted, 1)))
        first, second = pairs.T
        lengths = np.full((len(points), len(points)), np.inf)
        np.fill_diagonal(lengths, 0.0)
        lengths[first, second] = lengths[second, first] = np.linalg.norm(points[first] - points[second], axis=1)
        pairs = pairs[_blocked(self._space, points, pairs, deadline)]
        first, second = pairs.T
        lengths[first, second] = lengths[second, first] = np.inf
        if not len(pairs):
            return Legs(lengths, pairs, np.zeros(1, dtype=np.int64), np.empty((0, 3)))
        if self._features is None or self._sight is None:
            few = len(self._space.needs) <= FEW_OBSTACLES
            make = partial(make_features, self._space)
            self._features = make() if few else heard(make, deadline=deadline, doing=DOING)
            self._sight = empty_sight(len(self._features.position))
        self._sight, drawn = self._search(self._features, self._sight, points, pairs, lengths, deadline)
        drawn = join(self._space, points, drawn, lengths, deadline)
        if drawn.missing.any():
            drawn = self._link(self._features, points, drawn, lengths, deadline)
        return pack(drawn, lengths)

    def _search(
        self,
        features: Features,
        sight: Sight,
        points: FloatArray,
        pairs: NDArray[np.int64],
        lengths: FloatArray,
        deadline: Deadline,
    ) -> tuple[Sight, Drawn]:
        """Polylines between pairs; those of one origin stand together, and are searched together."""
        seen = np.zeros((len(points), len(features.position)), dtype=np.uint8)
        firsts = np.flatnonzero(np.diff(pairs[:, 0], prepend=-1, append=-1))
        parts, used = [], 0
        for begin, end in deadline.slices(len(firsts) - 1, DOING):
            group = pairs[firsts[begin] : firsts[end]]
            search = partial(_chains, self._space, features, points, seen, sight, group)
            # the first origins find out who sees whom, which takes long among many obstacles
            *known, begins, counts, chains = search() if deadline.is_never else heard(search, deadline=deadline, doing=DOING)
            sight = Sight(*known)
            parts.append((begins + used, counts, chains))
            used += len(chains)
        begins, counts, chains = (np.concatenate(part) for part in zip(*parts, strict=True))
        drawn = Drawn(pairs, begins, counts, features.position[chains], features.along[chains])
        return sight, draw(self._space, points, drawn, lengths, deadline)

    def _link(self, features: Features, points: FloatArray, drawn: Drawn, lengths: FloatArray, deadline: Deadline) -> Drawn:
        """Search again, over all features and all bends, for a way between groups of points that have none yet.

        Each search starts in the group that sees least: where points are walled in, it ends soon.
        """
        features = unrestricted(features)
        sight = empty_sight(len(features.position))
        closed: list[int] = []
        while True:
            missing = drawn.pairs[drawn.missing]
            _, group = connected_components(np.isfinite(lengths), directed=False)
            sources = [int(np.argmax(group == name)) for name in np.setdiff1d(group[missing], group[closed])]
            if len(sources) < 2:
                return drawn
            source = min(sources, key=lambda point: self._num_seen(features, points[point]))
            inside = group == group[source]
            across = missing[inside[missing[:, 0]] != inside[missing[:, 1]]]
            across = np.where(inside[across[:, :1]], across, across[:, ::-1])
            across = across[np.argsort(across[:, 0], kind="stable")]
            sight, extra = self._search(features, sight, points, across, lengths, deadline)
            if extra.missing.all():
                closed.append(source)
                continue
            drawn, num_missing = merge(drawn, extra), len(missing) + 1
            while int(drawn.missing.sum()) < num_missing:
                num_missing = int(drawn.missing.sum())
                drawn = join(self._space, points, drawn, lengths, deadline)

    def _num_seen(self, features: Features, point: FloatArray) -> int:
        """How many features a point sees."""
        others = np.arange(1, len(features.position) + 1)
        pairs = np.stack([np.zeros_like(others), others], axis=1)
        return len(others) - int(blocked_pairs(self._space, np.vstack([point, features.position]), pairs).sum())


def _blocked(space: FreeSpace, points: FloatArray, pairs: NDArray[np.int64], deadline: Deadline) -> NDArray[np.bool_]:
    """`blocked_pairs`, some at a time."""
    parts = [blocked_pairs(space, points, pairs[begin:end]) for begin, end in deadline.slices(len(pairs), DOING, FIRST_PAIRS)]
    return np.concatenate([np.empty(0, dtype=np.bool_), *parts])


@compiled_for(
    FREE_SPACE, FEATURES, FLOATS_2, types.Array(types.uint8, 2, "C"), SIGHT, INTEGERS_2, error_model="numpy", nogil=True
)
def _chains(
    space: FreeSpace, features: Features, points: FloatArray, seen: NDArray[np.uint8], sight: Sight, pairs: NDArray[np.int64]
) -> tuple[NDArray[Any], ...]:
    """The features that shortest paths between pairs bend around.

    Args:
        space: What segments are checked against.
        features: Where paths may bend.
        points: (P, 3) m.
        seen: (P, F) what is known of who sees what, see `View`; filled further.
        sight: What features see of each other; filled further.
        pairs: (L, 2) from, to; pairs of one origin stand together.

    Returns:
        The sight's fields (not the sight itself: to make one, Python code would run, in which an interrupt may break); where
        each pair's chain begins, (L,); how long it is, (L,), -1 where none is found; the chains.
    """
    view = View(space, features, points, seen)
    num_features, num_pairs = features.position.shape[0], pairs.shape[0]
    parent, from_source = np.empty(num_features, dtype=np.int64), np.empty(num_features)
    begin, count = np.zeros(num_pairs, dtype=np.int64), np.full(num_pairs, -1, dtype=np.int64)
    chains, used = np.empty(4 * num_pairs + 16, dtype=np.int64), 0
    left = np.empty(num_pairs, dtype=np.int64)
    first = 0
    while first < num_pairs:
        source, num_left, stop = pairs[first, 0], 0, first
        for v in range(num_features):
            from_source[v] = segment_length(points[source], features.position[v])
        while stop < num_pairs and pairs[stop, 0] == source:
            target = pairs[stop, 1]
            straight, last = segment_length(points[source], points[target]), -1
            for share in ELLIPSES:
                _, last = within_ellipse(view, source, target, from_source, share * straight, parent)
                if last >= 0:
                    break
            if last >= 0:
                begin[stop] = used
                chains, used = _trace(chains, used, parent, last)
                count[stop] = used - begin[stop]
            else:
                left[num_left] = stop
                num_left += 1
            stop += 1
        if num_left > 0:
            best, lasts = np.full(num_left, np.inf), np.full(num_left, -1, dtype=np.int64)
            targets = np.empty(num_left, dtype=np.int64)
            for t in range(num_left):
                targets[t] = pairs[left[t], 1]
            sight = shortest(view, sight, source, targets, best, lasts, parent)
            for t in range(num_left):
                if lasts[t] >= 0:
                    begin[left[t]] = used
                    chains, used = _trace(chains, used, parent, lasts[t])
                    count[left[t]] = used - begin[left[t]]
        first = stop
    return sight.pool, sight.begin, sight.end, sight.used, begin, count, chains[:used].copy()


@compiled_for(writable(INTEGERS_1), types.int64, INTEGERS_1, types.int64, error_model="numpy")
def _trace(chains: NDArray[np.int64], used: int, parent: NDArray[np.int64], last: int) -> tuple[NDArray[np.int64], int]:
    """Append the chain that ends with feature ``last`` to the first ``used`` entries; return it all, and its size."""
    count, u = 0, last
    while u >= 0:
        count += 1
        u = parent[u]
    if used + count > chains.shape[0]:
        wider = np.empty(2 * (used + count), dtype=np.int64)
        for place in range(used):
            wider[place] = chains[place]
        chains = wider
    u = last
    for place in range(used + count - 1, used - 1, -1):
        chains[place] = u
        u = parent[u]
    return chains, used + count
