"""Compiled: shortest paths over what features see of each other, by one search a place (Dijkstra 1959)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_2, INTEGERS_2, compiled_for, compiled_lazily
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import FEATURES, Features
from flockopt.travel.frontier import UNMET, Frontier, empty_frontier, offer, take_least
from flockopt.travel.sight import SIGHT, Sight

__all__ = ["chains_between"]


#: How much longer than the shortest path one may be, as a multiple, that is looked at again, and
#: what share it must gain.
MOST_SLACK, LEAST_GAIN = 1.3, 1e-3


class Search(NamedTuple):
    """How far a search from one place has come."""

    frontier: Frontier  # whose keys are the lengths of the best paths so far, metres
    parent: NDArray[np.int64]  # (F,) the feature before each, -1 if it is seen from the place


@compiled_for(SIGHT, FEATURES, SIGHT, FLOATS_2, INTEGERS_2, types.boolean, error_model="numpy", nogil=True)
def chains_between(
    sight: Sight, features: Features, seen: Sight, points: FloatArray, pairs: NDArray[np.int64], others: bool
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The features that shortest paths between pairs of places bend around.

    Args:
        sight: What features see of each other.
        features: Where paths may bend.
        seen: What places see.
        points: (P, 3) m, the places.
        pairs: (L, 2) from, to; pairs of one origin stand together.
        others: Whether to look for more than the shortest ones.

    Returns:
        The lengths of the paths, (L,) m, infinite where there is none; where each pair's chains begin, (L,); how many features
        the shortest one has, and how many another one that may be shorter when it is taut, 0 where there is none, (L, 2); the
        chains.
    """
    num_features, num_pairs = sight.begin.shape[0] - 1, pairs.shape[0]
    search = Search(empty_frontier(num_features), np.empty(num_features, dtype=np.int64))
    begin, count = np.zeros(num_pairs, dtype=np.int64), np.zeros((num_pairs, 2), dtype=np.int64)
    lengths = np.full(num_pairs, np.inf)
    chains, used = np.empty(4 * num_pairs + 16, dtype=np.int64), 0
    for pair in range(num_pairs):
        if pair == 0 or pairs[pair, 0] != pairs[pair - 1, 0]:
            _search_from(sight, seen, pairs[pair, 0], search)
        lengths[pair], last = _last_before(seen, pairs[pair, 1], search)
        begin[pair] = used
        if last >= 0:
            chains, used = _trace(chains, used, search.parent, last)
            count[pair, 0] = used - begin[pair]
            if not others:
                continue
            other = _last_when_taut(features, seen, points, pairs[pair, 0], pairs[pair, 1], last, lengths[pair], search)
            if other != last:
                chains, used = _trace(chains, used, search.parent, other)
                count[pair, 1] = used - begin[pair] - count[pair, 0]
    return lengths, begin, count, chains[:used].copy()


@compiled_lazily(error_model="numpy")
def _search_from(sight: Sight, seen: Sight, source: int, search: Search) -> None:
    """Shortest paths from a place to all features."""
    frontier, parent, length = search.frontier, search.parent, search.frontier.key
    length[:] = np.inf
    frontier.place[:] = UNMET
    for entry in range(seen.begin[source], seen.begin[source + 1]):
        v = np.int64(seen.feature[entry])
        parent[v] = -1
        offer(frontier, v, seen.length[entry])
    while frontier.size[0] > 0:
        u = take_least(frontier)
        so_far = length[u]
        for entry in range(sight.begin[u], sight.begin[u + 1]):
            v = np.int64(sight.feature[entry])
            through = so_far + sight.length[entry]
            if through < length[v]:
                parent[v] = u
                offer(frontier, v, through)


@compiled_lazily(error_model="numpy")
def _last_before(seen: Sight, target: int, search: Search) -> tuple[float, int]:
    """How long the shortest path to a place is, metres, by the features that it sees, and the last of these; -1 without one."""
    best, last = np.inf, -1
    for entry in range(seen.begin[target], seen.begin[target + 1]):
        v = int(seen.feature[entry])
        whole = search.frontier.key[v] + seen.length[entry]
        if whole < best:
            best, last = whole, v
    return best, last


@compiled_lazily(error_model="numpy")
def _last_when_taut(
    features: Features,
    seen: Sight,
    points: FloatArray,
    source: int,
    target: int,
    shortest: int,
    length: float,
    search: Search,
) -> int:
    """The last feature on the path that is shortest if its last bend is where it should be on its edge, not where a sample is.

    Unrolled about the edge the way from the bend before to the target is straight. The last feature of the ``shortest`` path,
    which is so long, stays it unless another one gains `LEAST_GAIN`.
    """
    position, along = features.position, features.along
    best, last, now = np.inf, shortest, np.inf
    for entry in range(seen.begin[target], seen.begin[target + 1]):
        v = int(seen.feature[entry])
        whole = search.frontier.key[v] + seen.length[entry]
        if whole > MOST_SLACK * length:
            continue
        u = search.parent[v]
        before, so_far = (position[u], search.frontier.key[u]) if u >= 0 else (points[source], 0.0)
        from_along, to_along, from_squared, to_squared = 0.0, 0.0, 0.0, 0.0
        for axis in range(3):
            come, go = before[axis] - position[v, axis], points[target, axis] - position[v, axis]
            from_along, to_along = from_along + come * along[v, axis], to_along + go * along[v, axis]
            from_squared, to_squared = from_squared + come * come, to_squared + go * go
        from_beside = math.sqrt(max(from_squared - from_along * from_along, 0.0))
        to_beside = math.sqrt(max(to_squared - to_along * to_along, 0.0))
        beside = from_beside + to_beside
        at = from_along + (to_along - from_along) * from_beside / beside if beside > 0.0 else 0.0
        at = min(max(at, features.back[v]), features.onward[v])
        taut = so_far + math.hypot(from_beside, at - from_along) + math.hypot(to_beside, to_along - at)
        if v == shortest:
            now = taut
        if taut < best:
            best, last = taut, v
    return last if best < (1.0 - LEAST_GAIN) * now else shortest


@compiled_lazily(error_model="numpy")
def _trace(chains: NDArray[np.int64], used: int, parent: NDArray[np.int64], last: int) -> tuple[NDArray[np.int64], int]:
    """Append the chain that ends with feature ``last`` to the first ``used`` entries; return it all, and its size."""
    count, u = 0, last
    while u >= 0:
        count += 1
        u = parent[u]
    if used + count > chains.shape[0]:
        wider = np.empty(2 * (used + count), dtype=np.int64)
        wider[:used] = chains[:used]
        chains = wider
    u = last
    for place in range(used + count - 1, used - 1, -1):
        chains[place] = u
        u = parent[u]
    return chains, used + count
