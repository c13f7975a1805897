"""Compiled: chains of features made taut polylines, which stay clear: bends slide, wind around cores, retract and vanish.

Most are done at once: each bend where the closed form says (`flockopt.travel.winding`), a few times in turn, and one look
at the whole in the end. Where that comes too near to something, each step is looked at, and taken as far as it is clear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_2, INTEGERS_1, INTEGERS_2, compiled_for, compiled_lazily
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import FEATURES, Features
from flockopt.travel.surroundings import (
    EASED,
    SURROUNDINGS,
    Eased,
    Surroundings,
    ease,
    is_within,
    obstructed,
    own_needs,
    restore,
)  # fmt: skip
from flockopt.travel.winding import LOOSE, WOUND, heights_along, run_end, wound

__all__ = ["tightened"]

#: Rounds over all bends at once, and of less movement than this, metres, no more.
MOST_SWEEPS, LEAST_MOVE_M = 6, 1e-4
#: Rounds over all bends with a look at each, and halvings in one search for how far a bend may retract, at most.
MOST_ROUNDS, MOST_HALVINGS = 4, 10
#: A gain of less than this share of the length is not worth a round.
LEAST_GAIN = 2e-4
#: How much of the way to a bend's best place is tried, in this order.
SHARES = (1.0, 0.5, 0.25)


@compiled_for(
    SURROUNDINGS, EASED, FLOATS_2, FEATURES, INTEGERS_2, INTEGERS_1, INTEGERS_2, INTEGERS_1, error_model="numpy", nogil=True
)  # fmt: skip
def tightened(
    around: Surroundings, eased: Eased, points: FloatArray, features: Features, pairs: NDArray[np.int64],
    begin: NDArray[np.int64], count: NDArray[np.int64], chains: NDArray[np.int64],
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64], FloatArray]:  # fmt: skip
    """Taut polylines between pairs of places, along the chains of features that their shortest paths bend around.

    Args:
        around: Obstacles, needs and bounds.
        eased: What the places need less of.
        points: (P, 3) m, the places.
        features: Where paths may bend.
        pairs: (L, 2) from, to.
        begin: (L,) where each pair's chain begins.
        count: (L, 2) how many features it has, and how many another one after it, 0 where there is none.
        chains: (B,) features.

    Returns:
        (L,) m, their lengths; (L,) where each one's bends begin; (L,) how many it has;
        (B, 3) m, the bends.
    """
    lengths, first_bend = np.empty(pairs.shape[0]), np.zeros(pairs.shape[0], dtype=np.int64)
    num_bends, used = np.zeros(pairs.shape[0], dtype=np.int64), 0
    bends, most = np.empty((chains.shape[0], 3)), 0
    for leg in range(pairs.shape[0]):
        most = max(most, count[leg, 0], count[leg, 1])
    path, other, chain = np.zeros((most + 2, 3)), np.zeros((most + 2, 3)), np.zeros(most + 2, dtype=np.int64)
    own = own_needs(around)
    for leg in range(pairs.shape[0]):
        i, j = pairs[leg, 0], pairs[leg, 1]
        ease(own, eased, i)
        ease(own, eased, j)
        first, middle = begin[leg], begin[leg] + count[leg, 0]
        size = _tight(own, features, points, i, j, chains[first:middle], path, chain)
        if count[leg, 1] > 0:
            other_size = _tight(own, features, points, i, j, chains[middle : middle + count[leg, 1]], other, chain)
            if _length(other, other_size) < _length(path, size):
                path, other, size = other, path, other_size
        restore(own, around, eased, i)
        restore(own, around, eased, j)
        lengths[leg], first_bend[leg], num_bends[leg] = _length(path, size), used, size - 2
        bends[used : used + size - 2] = path[1 : size - 1]
        used += size - 2
    return lengths, first_bend, num_bends, bends[:used].copy()


@compiled_lazily(error_model="numpy")
def _tight(
    around: Surroundings, features: Features, points: FloatArray, i: int, j: int, over: NDArray[np.int64], path: FloatArray,
    chain: NDArray[np.int64],
) -> int:  # fmt: skip
    """Fill ``path`` with the taut one from place i to place j along a chain; how many vertices it has."""
    size = _all_at_once(around, features, path, chain, _begin(path, chain, points, i, j, features, over))
    if size < 0:
        size = _begin(path, chain, points, i, j, features, over)
    else:
        given, size = size, _skip(around, path, chain, size)
        if size == given and not _is_held(features, path, chain, size):
            return size
    return _one_by_one(around, features, path, chain, size)


@compiled_lazily(error_model="numpy")
def _is_held(features: Features, path: FloatArray, chain: NDArray[np.int64], size: int) -> bool:
    """Whether some bend is where the free stretch of its edge ends: it may do better a little beside the edge."""
    for i in range(1, size - 1):
        f, along = chain[i], 0.0
        for axis in range(3):
            along += (path[i, axis] - features.position[f, axis]) * features.along[f, axis]
        if min(along - features.back[f], features.onward[f] - along) < LEAST_MOVE_M and features.back[f] < features.onward[f]:
            return True
    return False


@compiled_lazily(error_model="numpy")
def _begin(
    path: FloatArray, chain: NDArray[np.int64], points: FloatArray, i: int, j: int, features: Features, over: NDArray[np.int64]
) -> int:
    """Fill the path from place i to place j over some features; how many vertices it has."""
    size = over.shape[0] + 2
    for axis in range(3):
        path[0, axis], path[size - 1, axis] = points[i, axis], points[j, axis]
        for k in range(size - 2):
            path[k + 1, axis] = features.position[over[k], axis]
    for k in range(size - 2):
        chain[k + 1] = over[k]
    return size


@compiled_lazily(error_model="numpy")
def _drop(path: FloatArray, chain: NDArray[np.int64], size: int, i: int) -> int:
    """Leave bend i out; how many vertices are left."""
    for k in range(i, size - 1):
        chain[k] = chain[k + 1]
        for axis in range(3):
            path[k, axis] = path[k + 1, axis]
    return size - 1


@compiled_lazily(error_model="numpy")
def _all_at_once(around: Surroundings, features: Features, path: FloatArray, chain: NDArray[np.int64], size: int) -> int:
    """Put all bends where the closed form says; how many vertices are left, -1 if what comes of it is not clear, or longer."""
    before = _length(path, size)
    size = _settled(around, features, path, chain, size)
    for i in range(size - 1):
        if not is_within(around, path[i]) or obstructed(around, path[i], path[i + 1]):
            return -1
    return size if size < 0 or _length(path, size) <= before else -1


@compiled_lazily(error_model="numpy")
def _settled(around: Surroundings, features: Features, path: FloatArray, chain: NDArray[np.int64], size: int) -> int:
    """Place bends in turn until they stay where they are; how many vertices are left, -1 if one is neither needed nor clear."""
    bend, gates, moves = np.empty(3), np.empty((size + 1, 5)), np.zeros(size)
    for _ in range(MOST_SWEEPS):
        moved, i = 0.0, 1
        while i < size - 1:
            found = wound(features, chain[i], path[i - 1], path[i], path[i + 1], bend)
            if found == LOOSE:
                if obstructed(around, path[i - 1], path[i + 1]):
                    return -1
                size, moved, i = _drop(path, chain, size, i), 1.0, max(i - 1, 1)
                continue
            if found == WOUND:
                for axis in range(3):
                    moved = max(moved, abs(bend[axis] - path[i, axis]))
                    path[i, axis] = bend[axis]
            i += 1
        moved = max(moved, _even_all(features, path, chain, size, gates, moves))
        if moved < LEAST_MOVE_M:
            break
    return size


@compiled_lazily(error_model="numpy")
def _even_all(
    features: Features, path: FloatArray, chain: NDArray[np.int64], size: int, gates: FloatArray, moves: FloatArray
) -> float:
    """Let runs of bends around parallel edges climb evenly; how far any of them moved, metres."""
    moved, first = 0.0, 1
    while first < size - 1:
        last = run_end(features, chain, first, size)
        if last > first or features.room[chain[first]] <= 0.0:
            heights_along(features, chain, path, first, last, True, gates, moves)
            for i in range(first, last + 1):
                moved = max(moved, abs(moves[i]))
                for axis in range(3):
                    path[i, axis] += moves[i] * features.along[chain[i], axis]
        first = last + 1
    return moved


@compiled_lazily(error_model="numpy")
def _one_by_one(around: Surroundings, features: Features, path: FloatArray, chain: NDArray[np.int64], size: int) -> int:
    """Shorten the clear path step by clear step; how many vertices are left."""
    length, bend, gates, moves = np.inf, np.empty(3), np.empty((size + 1, 5)), np.zeros(size)
    for _ in range(MOST_ROUNDS):
        size = _skip(around, path, chain, size)
        shorter = _length(path, size)
        if length - shorter <= LEAST_GAIN * shorter:
            break
        length = shorter
        first = 1
        while first < size - 1:
            last = run_end(features, chain, first, size)
            is_held = heights_along(features, chain, path, first, last, True, gates, moves)
            _move_along(around, features, path, chain, first, last, moves)
            if is_held:  # beside the edge there may be room beyond where its free stretch ends
                heights_along(features, chain, path, first, last, False, gates, moves)
                _move_along(around, features, path, chain, first, last, moves)
            first = last + 1
        for i in range(1, size - 1):
            found = wound(features, chain[i], path[i - 1], path[i], path[i + 1], bend)
            if found == WOUND and _move_towards(around, path, i, bend):
                continue
            for side in range(-1, 2, 2):
                _retract(around, path, i, i + side, i - side, 0.5 * LEAST_GAIN * length)
    return size


@compiled_lazily(error_model="numpy")
def _length(path: FloatArray, size: int) -> float:
    total = 0.0
    for i in range(size - 1):
        total += segment_length(path[i], path[i + 1])
    return total


@compiled_lazily(error_model="numpy")
def _skip(around: Surroundings, path: FloatArray, chain: NDArray[np.int64], size: int) -> int:
    """Remove bends whose neighbours see each other; how many vertices are left."""
    i = 1
    while i < size - 1:
        if not obstructed(around, path[i - 1], path[i + 1]):
            size, i = _drop(path, chain, size, i), max(i - 1, 1)
        else:
            i += 1
    return size


@compiled_lazily(error_model="numpy")
def _move_along(
    around: Surroundings,
    features: Features,
    path: FloatArray,
    chain: NDArray[np.int64],
    first: int,
    last: int,
    moves: FloatArray,
) -> None:
    """Move bends ``first`` to ``last`` along their edges, all by the same share of ``moves``, if that is clear and shorter."""
    before, after, length = np.empty(3), np.empty(3), 0.0
    for i in range(first, last + 2):
        length += segment_length(path[i - 1], path[i])
    for share in SHARES:
        clear, left = True, length
        for i in range(first, last + 2):
            for axis in range(3):
                before[axis], after[axis] = path[i - 1, axis], path[i, axis]
                if i > first:
                    before[axis] += share * moves[i - 1] * features.along[chain[i - 1], axis]
                if i <= last:
                    after[axis] += share * moves[i] * features.along[chain[i], axis]
            left -= segment_length(before, after)
            clear = clear and is_within(around, after) and not obstructed(around, before, after)
        if clear and left >= 0.0:
            for i in range(first, last + 1):
                for axis in range(3):
                    path[i, axis] += share * moves[i] * features.along[chain[i], axis]
            break


@compiled_lazily(error_model="numpy")
def _move_towards(around: Surroundings, path: FloatArray, i: int, bend: FloatArray) -> bool:
    """Move bend i towards its best place as far as that is clear; whether it got there."""
    start, moved = path[i].copy(), np.empty(3)
    length = segment_length(path[i - 1], start) + segment_length(start, path[i + 1])
    for share in SHARES:
        for axis in range(3):
            moved[axis] = start[axis] + share * (bend[axis] - start[axis])
        if segment_length(path[i - 1], moved) + segment_length(moved, path[i + 1]) > length or not is_within(around, moved):
            continue
        if not obstructed(around, path[i - 1], moved) and not obstructed(around, moved, path[i + 1]):
            for axis in range(3):
                path[i, axis] = moved[axis]
            return share == 1.0
    return False


@compiled_lazily(error_model="numpy")
def _retract(around: Surroundings, path: FloatArray, i: int, toward: int, away: int, least_gain: float) -> None:
    """Move bend i along its own segment to ``toward`` until the other segment touches an obstacle.

    The one segment stays on its line, hence clear, and by the triangle inequality the path gets no longer. The
    length is a convex function of how far the bend has moved, so its slope at a clear place bounds what more
    there is to gain; less than ``least_gain`` metres is left alone.
    """
    start, moved, end = np.empty(3), np.empty(3), np.empty(3)
    for axis in range(3):
        start[axis], moved[axis], end[axis] = path[i, axis], path[i, axis], path[away, axis]
    whole = segment_length(start, path[toward])
    low, high = 0.0, 1.0
    for _ in range(MOST_HALVINGS):
        onward = segment_length(path[i], end)
        ahead = 0.0
        for axis in range(3):
            ahead += (path[toward, axis] - start[axis]) * (end[axis] - path[i, axis])
        # one plus the cosine between the two segments: zero where the path is straight
        if (high - low) * whole * (1.0 + ahead / max(whole * onward, 1e-300)) <= least_gain:
            break
        middle = 0.5 * (low + high)
        for axis in range(3):
            moved[axis] = start[axis] + middle * (path[toward, axis] - start[axis])
        if not obstructed(around, moved, end):
            low = middle
            for axis in range(3):
                path[i, axis] = moved[axis]
        else:
            high = middle
