"""Compiled: the features that a search has met and not settled, least key first, in a binary heap.

The heap knows where each feature stands in it, so that a feature met again on a shorter way moves up in place and is
never in it twice.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.records.arrays import FloatArray

__all__ = ["UNMET", "Frontier", "empty_frontier", "offer", "take_least"]

#: Values of `Frontier.place` for features that are not in the heap.
UNMET, SETTLED = -1, -2


class Frontier(NamedTuple):
    """A heap of some of F features."""

    heap: NDArray[np.int64]  # (F,) features, the one with the least key first; filled up to the size
    size: NDArray[np.int64]  # (1,)
    place: NDArray[np.int64]  # (F,) where a feature stands in the heap, `UNMET` or `SETTLED`
    key: FloatArray  # (F,)


@compiled_lazily(error_model="numpy")
def empty_frontier(num_features: int) -> Frontier:
    """No feature met yet."""
    heap, place = np.empty(num_features, dtype=np.int64), np.full(num_features, UNMET, dtype=np.int64)
    return Frontier(heap, np.zeros(1, dtype=np.int64), place, np.empty(num_features))


@compiled_lazily(error_model="numpy")
def offer(frontier: Frontier, v: int, key: float) -> None:
    """Put a feature in, or move it up to a smaller key than it had."""
    heap, place, keys = frontier.heap, frontier.place, frontier.key
    keys[v] = key
    at = place[v]
    if at < 0:
        at = frontier.size[0]
        frontier.size[0] = at + 1
    while at > 0:
        above = (at - 1) // 2
        if keys[heap[above]] <= key:
            break
        heap[at] = heap[above]
        place[heap[at]] = at
        at = above
    heap[at] = v
    place[v] = at


@compiled_lazily(error_model="numpy")
def take_least(frontier: Frontier) -> int:
    """Take out the feature with the least key; it counts as settled."""
    heap, place, keys = frontier.heap, frontier.place, frontier.key
    top, size = heap[0], frontier.size[0] - 1
    place[top], frontier.size[0] = SETTLED, size
    if size > 0:
        v, at = heap[size], 0
        while True:
            child = 2 * at + 1
            if child >= size:
                break
            if child + 1 < size and keys[heap[child + 1]] < keys[heap[child]]:
                child += 1
            if keys[heap[child]] >= keys[v]:
                break
            heap[at] = heap[child]
            place[heap[at]] = at
            at = child
        heap[at] = v
        place[v] = at
    return top
