"""Compiled: who sees whom along lines that a shortest path may take: the tangent graph.

A shortest path is taut: it leaves an obstacle along a tangent. So two features are joined where the line between them is
clear and touches the obstacles of both (Lozano-Perez and Wesley 1979; in space a graph's nodes are samples of edges, since the
best bend may be anywhere on an edge). What features see of each other is looked for once; places come and go, and see for
themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, compiled_for, compiled_lazily, record_of
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import FEATURES, Features
from flockopt.travel.surroundings import EASED, SURROUNDINGS, Eased, Surroundings, ease, obstruction, own_needs, restore

__all__ = ["SIGHT", "Sight", "seen_by_features", "seen_by_places", "sight_of"]


class Sight(NamedTuple):
    """Which features each of some viewers sees, and how far away they are."""

    begin: NDArray[np.int64]  # (V + 1,) where a viewer's features begin
    feature: NDArray[np.int32]
    length: FloatArray  # m


#: The same as compiled code knows it.
SIGHT = record_of(Sight, INTEGERS_1, types.Array(types.int32, 1, "C"), FLOATS_1)


@compiled_lazily(error_model="numpy")
def _columns(features: Features) -> FloatArray:
    """(11, F) positions, both normals, slacks and caps, a row a number, so that a loop over features takes several at once."""
    columns = np.empty((11, features.position.shape[0]))
    for v in range(features.position.shape[0]):
        for axis in range(3):
            columns[axis, v] = features.position[v, axis]
            columns[3 + axis, v], columns[6 + axis, v] = features.first[v, axis], features.second[v, axis]
        columns[9, v], columns[10, v] = features.slack[v], features.cap[v]
    return columns


@compiled_lazily(error_model="numpy")
def _mark_tangent(columns: FloatArray, x: float, y: float, z: float, may: NDArray[np.bool_]) -> None:
    """Mark the features at which a line from (x, y, z) stays out of the prism."""
    for v in range(columns.shape[1]):
        dx, dy, dz = columns[0, v] - x, columns[1, v] - y, columns[2, v] - z
        a = dx * columns[3, v] + dy * columns[4, v] + dz * columns[5, v]
        b = dx * columns[6, v] + dy * columns[7, v] + dz * columns[8, v]
        squared = dx * dx + dy * dy + dz * dz
        may[v] = (a * b <= columns[9, v] * squared) | (columns[10, v] * dz * a <= columns[9, v] * squared)


@compiled_lazily(error_model="numpy")
def _mark_tangent_here(columns: FloatArray, u: int, may: NDArray[np.bool_]) -> None:
    """Mark the features to which a line from feature u is tangent at both."""
    x, y, z, here, cap = columns[0, u], columns[1, u], columns[2, u], columns[9, u], columns[10, u]
    c0, c1, c2, d0, d1, d2 = columns[3, u], columns[4, u], columns[5, u], columns[6, u], columns[7, u], columns[8, u]
    for v in range(columns.shape[1]):  # all of them: so it is compiled to several at once
        dx, dy, dz = columns[0, v] - x, columns[1, v] - y, columns[2, v] - z
        a = dx * columns[3, v] + dy * columns[4, v] + dz * columns[5, v]
        b = dx * columns[6, v] + dy * columns[7, v] + dz * columns[8, v]
        c, d = dx * c0 + dy * c1 + dz * c2, dx * d0 + dy * d1 + dz * d2
        squared = dx * dx + dy * dy + dz * dz
        there = (a * b <= columns[9, v] * squared) | (columns[10, v] * dz * a <= columns[9, v] * squared)
        may[v] = there & ((c * d <= here * squared) | (cap * dz * c <= here * squared))


@compiled_lazily(error_model="numpy")
def _noted(seen: NDArray[np.int32], used: int, u: int, v: int) -> NDArray[np.int32]:
    """The pairs seen, with one more."""
    if used == seen.shape[0]:
        wider = np.empty((2 * used, 2), dtype=np.int32)
        wider[:used] = seen
        seen = wider
    seen[used, 0], seen[used, 1] = u, v
    return seen


@compiled_for(SURROUNDINGS, FEATURES, INTEGERS_1, types.boolean, error_model="numpy", nogil=True)
def seen_by_features(around: Surroundings, features: Features, viewers: NDArray[np.int64], anyhow: bool) -> NDArray[np.int32]:
    """Which later features some of them see, (S, 2): along lines tangent at both, or along any line."""
    seen, used = np.empty((64, 2), dtype=np.int32), 0
    position, columns = features.position, _columns(features)
    may, guesses = np.ones(position.shape[0], dtype=np.bool_), np.full(around.rows.shape[0] + 1, -1)
    for u in viewers:
        x, y, z = position[u, 0], position[u, 1], position[u, 2]
        if not anyhow:
            _mark_tangent_here(columns, u, may)
        one = -1 if anyhow else features.prism[u]
        for v in range(0 if anyhow else u + 1, position.shape[0]):
            if not may[v]:
                continue
            other = -1 if anyhow else features.prism[v]
            found = obstruction(
                around, x, y, z, position[v, 0], position[v, 1], position[v, 2], guesses[features.owner[v]], one, other
            )
            if found >= 0:
                guesses[features.owner[v]] = found
            elif u != v:
                seen = _noted(seen, used, u, v)
                used += 1
    return seen[:used].copy()


@compiled_for(SURROUNDINGS, EASED, FEATURES, FLOATS_2, types.int64, types.int64, types.boolean, error_model="numpy", nogil=True)
def seen_by_places(
    around: Surroundings, eased: Eased, features: Features, points: FloatArray, first: int, last: int, anyhow: bool
) -> NDArray[np.int32]:
    """Which features the places from ``first`` to ``last`` (excluded) see, (S, 2): along lines tangent there, or along any."""
    seen, used = np.empty((64, 2), dtype=np.int32), 0
    position, columns, own = features.position, _columns(features), own_needs(around)
    may, guesses = np.ones(position.shape[0], dtype=np.bool_), np.full(around.rows.shape[0] + 1, -1)
    for place in range(first, last):
        ease(own, eased, place)
        x, y, z = points[place, 0], points[place, 1], points[place, 2]
        if not anyhow:
            _mark_tangent(columns, x, y, z, may)
        for v in range(position.shape[0]):
            if not may[v]:
                continue
            other = -1 if anyhow else features.prism[v]
            found = obstruction(
                own, x, y, z, position[v, 0], position[v, 1], position[v, 2], guesses[features.owner[v]], -1, other
            )
            if found >= 0:
                guesses[features.owner[v]] = found
            else:
                seen = _noted(seen, used, place, v)
                used += 1
        restore(own, around, eased, place)
    return seen[:used].copy()


def sight_of(seen: list[NDArray[np.int32]], viewers: FloatArray, features: Features, mutual: bool) -> Sight:
    """The sight of viewers (V, 3) m from the pairs that were seen; ``mutual`` where viewers are the features themselves."""
    pairs = np.concatenate([np.empty((0, 2), dtype=np.int32), *seen])
    return Sight(*_sorted(pairs, viewers, features.position, mutual))


@compiled_for(
    types.Array(types.int32, 2, "C", readonly=True), FLOATS_2, FLOATS_2, types.boolean, error_model="numpy", nogil=True
)
def _sorted(
    pairs: NDArray[np.int32], viewers: FloatArray, position: FloatArray, mutual: bool
) -> tuple[NDArray[np.int64], NDArray[np.int32], FloatArray]:
    """`Sight`'s fields."""
    begin = np.zeros(viewers.shape[0] + 2, dtype=np.int64)  # one ahead, so that filling leaves each where its own begins
    num_pairs = pairs.shape[0]
    for pair in range(num_pairs):
        begin[pairs[pair, 0] + 2] += 1
        if mutual:
            begin[pairs[pair, 1] + 2] += 1
    for viewer in range(2, begin.shape[0]):
        begin[viewer] += begin[viewer - 1]
    feature = np.empty(begin[-1], dtype=np.int32)
    length = np.empty(begin[-1])
    for turn in range(2 if mutual else 1):
        for pair in range(num_pairs):
            u, v = pairs[pair, turn], pairs[pair, 1 - turn]
            feature[begin[u + 1]] = v
            length[begin[u + 1]] = segment_length(viewers[u], position[v])
            begin[u + 1] += 1
    return begin[:-1].copy(), feature, length
