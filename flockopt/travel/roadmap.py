"""Shortest any-angle paths among obstacles in 3-D: around, over and under them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from flockopt.batches.deadline import NEVER, Deadline, heard
from flockopt.batches.threads import spread
from flockopt.geometry.distances import OBSTACLE_COLUMNS, distances
from flockopt.geometry.free_space import free_space
from flockopt.records.arrays import FloatArray
from flockopt.travel.bends import Features, ball_features, make_features
from flockopt.travel.legs import Legs, legs_of
from flockopt.travel.path_search import chains_between
from flockopt.travel.sight import Sight, seen_by_features, seen_by_places, sight_of
from flockopt.travel.surroundings import Eased, blocked_between, eased_places, surroundings, uneased
from flockopt.travel.tightening import tightened

__all__ = ["Roadmap", "roadmap_among"]

#: What it does, for those who give it a deadline; pairs and legs before the clock is read first.
DOING, FIRST_PAIRS, FIRST_LEGS = "finding ways among obstacles", 1024, 64

#: Of more legs that bend than this, only those are pulled taut that lead to a place's so many nearest ones, by travel.
MANY_LEGS, NUM_NEAR = 100_000, 60

#: How many roadmaps are remembered: those of a scene's kinds of drones, each with less and less margin, and of their detours.
ROADMAPS_KEPT = 12

#: Among up to so many obstacles, features are made too soon to be interrupted.
FEW_OBSTACLES = 300


@dataclass(frozen=True, eq=False)
class Bends:
    """Where ways may bend, and what is seen from there."""

    features: Features
    sight: Sight


def roadmap_among(table: FloatArray, need: float, bounds: ArrayLike, margin: float = 0.0) -> Roadmap:
    """The roadmap for this kind of drone among these obstacles: the one that was last made for the same, with all it knows.

    Args:
        table: As of `Roadmap`.
        need: As of `Roadmap`.
        bounds: As of `Roadmap`.
        margin: As of `Roadmap`.
    """
    table, corners = np.ascontiguousarray(table, dtype=np.float64), np.array(bounds, dtype=np.float64)
    return _roadmap(table.tobytes(), float(need), corners.tobytes(), float(margin))


@lru_cache(maxsize=ROADMAPS_KEPT)
def _roadmap(table: bytes, need: float, bounds: bytes, margin: float) -> Roadmap:
    rows, corners = (np.frombuffer(data, dtype=np.float64) for data in (table, bounds))
    return Roadmap(rows.reshape(-1, len(OBSTACLE_COLUMNS)), need, corners.reshape(2, 3), margin)


class Roadmap:
    """Paths for one kind of drone among fixed obstacles.

    Where ways may bend, and who sees whom there, is found when a straight flight is first blocked, and kept: places that
    come later only look for what they see themselves. A path depends on its two places, the obstacles and the bounds alone.
    Among very many places, only the paths to near ones are pulled taut: see `MANY_LEGS`.

    Args:
        table: (K, 9) obstacles, see `flockopt.geometry.distances.OBSTACLE_COLUMNS`.
        need: m, least distance of the drone's centre from each obstacle.
        bounds: (2, 3) m or (lower, upper): the space paths stay within.
        margin: m, what paths keep beyond ``need``, except from obstacles that their ends are nearer to: there it is half the
            room that the end has.
    """

    def __init__(self, table: FloatArray, need: float, bounds: ArrayLike, margin: float = 0.0) -> None:
        self._need, self._margin = float(need), float(margin)
        self._space = free_space(table, self._need + self._margin, bounds)
        self._around = surroundings(self._space)
        self._bends: Bends | None = None
        self._linked: Bends | None = None

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
        eased = Eased(*eased_places(self._around, points, self._need, self._margin))
        is_clear = np.logical_not(self._blocked(eased, points, pairs, deadline))
        straight = np.linalg.norm(points[first[is_clear]] - points[second[is_clear]], axis=1)
        lengths[first[is_clear], second[is_clear]] = lengths[second[is_clear], first[is_clear]] = straight
        pairs, found = _from_the_same(points, pairs[~is_clear]), [_Chains.none()]
        for anyhow in (False, True):
            if len(pairs):
                chains, missing = self._chains(eased, points, pairs, anyhow, deadline).split()
                found, pairs = [*found, chains], missing
        chains = _Chains.joined(found)
        first, second = chains.pairs.T
        lengths[first, second] = lengths[second, first] = chains.lengths
        if not len(chains.pairs):
            return Legs(lengths, chains.pairs, np.zeros(1, dtype=np.int64), np.empty((0, 3)))
        return self._tight(eased, points, chains, lengths, deadline)

    def with_balls(self, rows: FloatArray, deadline: Deadline = NEVER) -> Roadmap:
        """The same with more obstacles: spheres, (R, 9). What is known of the others is used again.

        Narrow gaps between the new ones and the old ones are not looked for.

        Raises:
            OutOfTime: If the deadline passes.
        """
        old, num_old = self._known_bends(False, deadline), len(self._space.table)
        bounds, reach = (self._space.lower, self._space.upper), self._need + self._margin
        more = Roadmap(np.vstack([self._space.table, rows]), self._need, bounds, self._margin)
        balls, around = ball_features(more._space, num_old), surroundings(free_space(rows, reach, bounds))
        kept = distances(rows, old.features.position).min(axis=1, initial=np.inf) >= reach
        own = old.features._replace(owner=np.where(old.features.owner < num_old, old.features.owner, len(more._space.table)))
        both = [np.concatenate([new, column[kept]]) for new, column in zip(balls, own, strict=True)]
        features = Features(*both)
        place = np.where(kept, len(balls.position) + np.cumsum(kept) - 1, -1)
        pairs = place[_pairs_of(old.sight)]
        pairs = np.ascontiguousarray(pairs[(pairs >= 0).all(axis=1)])
        pairs = pairs[~blocked_between(around, uneased(len(features.position)), features.position, pairs)].astype(np.int32)
        seen = more._seen(features, np.arange(len(balls.position)), False, deadline)
        more._bends = Bends(features, sight_of([pairs, *seen], features.position, features, True))
        return more

    def _blocked(self, eased: Eased, points: FloatArray, pairs: NDArray[np.int64], deadline: Deadline) -> NDArray[np.bool_]:
        """Whether the straight flight between each pair is blocked."""

        def look(begin: int, end: int) -> NDArray[np.bool_]:
            return blocked_between(self._around, eased, points, pairs[begin:end])

        return np.concatenate([np.empty(0, dtype=np.bool_), *spread(look, len(pairs), DOING, deadline, FIRST_PAIRS)])

    def _chains(self, eased: Eased, points: FloatArray, pairs: NDArray[np.int64], anyhow: bool, deadline: Deadline) -> _Chains:
        """The features that ways between pairs of places bend around, by all lines that are clear if ``anyhow``."""
        bends = self._known_bends(anyhow, deadline)
        used, place = np.unique(pairs, return_inverse=True)
        places, own = np.ascontiguousarray(points[used]), _eased_of(eased, used)
        local = np.ascontiguousarray(place.reshape(pairs.shape))

        def look(begin: int, end: int) -> NDArray[np.int32]:
            return seen_by_places(self._around, own, bends.features, places, begin, end, anyhow)

        seen = sight_of(spread(look, len(places), DOING, deadline), places, bends.features, mutual=False)
        firsts = np.flatnonzero(np.diff(local[:, 0], prepend=-1, append=-1))

        def search(begin: int, end: int) -> _Chains:
            group = slice(firsts[begin], firsts[end])
            others = len(pairs) <= MANY_LEGS
            return _Chains(pairs[group], *chains_between(bends.sight, bends.features, seen, places, local[group], others))

        return _Chains.joined(spread(search, len(firsts) - 1, DOING, deadline))

    def _tight(self, eased: Eased, points: FloatArray, chains: _Chains, lengths: FloatArray, deadline: Deadline) -> Legs:
        """Legs along chains, pulled taut; among many places only those to near ones, for routes hardly use others.

        Fills ``lengths``, which hold the straight legs, and those along the chains as they are.
        """
        features, pairs = self._known_bends(False, deadline).features, chains.pairs
        tight = np.ones(len(pairs), dtype=np.bool_)
        if len(pairs) > MANY_LEGS:
            reach = np.partition(lengths, NUM_NEAR, axis=1)[:, NUM_NEAR]  # (P,) m, how far a place's near ones are
            tight = lengths[pairs[:, 0], pairs[:, 1]] <= np.maximum(reach[pairs[:, 0]], reach[pairs[:, 1]])
        chosen = np.flatnonzero(tight)

        def pull(begin: int, end: int) -> tuple[NDArray[Any], ...]:
            some = chosen[begin:end]
            return tightened(
                self._around, eased, points, features, pairs[some], chains.begin[some], chains.count[some], chains.features
            )

        parts = spread(pull, len(chosen), DOING, deadline, FIRST_LEGS)
        bends = [features.position[chains.features], *(part[3] for part in parts)]
        begin, count = chains.begin.copy(), chains.count[:, 0].copy()
        if len(chosen):
            offsets = np.cumsum([len(bend) for bend in bends])
            begin[tight] = np.concatenate([part[1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)])
            count[tight] = np.concatenate([part[2] for part in parts])
            first, second = pairs[tight].T
            lengths[first, second] = lengths[second, first] = np.concatenate([part[0] for part in parts])
        return legs_of(lengths, pairs, begin, count, np.concatenate(bends))

    def _known_bends(self, anyhow: bool, deadline: Deadline) -> Bends:
        """Where ways may bend, and what is seen from there; with links between what tangents do not join if ``anyhow``."""
        space = self._space
        if self._bends is None:
            few = len(space.needs) <= FEW_OBSTACLES
            make = partial(make_features, space)
            features = make() if few else heard(make, deadline=deadline, doing=DOING)
            everybody = np.arange(len(features.position))
            self._bends = Bends(
                features, sight_of(self._seen(features, everybody, False, deadline), features.position, features, True)
            )
        if not anyhow:
            return self._bends
        if self._linked is None:
            self._linked = self._with_links(self._bends, deadline)
        return self._linked

    def _seen(
        self, features: Features, viewers: NDArray[np.int64], anyhow: bool, deadline: Deadline
    ) -> list[NDArray[np.int32]]:
        def look(begin: int, end: int) -> NDArray[np.int32]:
            return seen_by_features(self._around, features, viewers[begin:end], anyhow)

        return spread(look, len(viewers), DOING, deadline)

    def _with_links(self, bends: Bends, deadline: Deadline) -> Bends:
        """The same bends, and between groups of them that no tangents join whatever lines are clear."""
        sight, count = bends.sight, len(bends.features.position)
        graph = csr_matrix((np.ones(len(sight.feature), dtype=np.bool_), sight.feature, sight.begin), shape=(count, count))
        _, group = connected_components(graph, directed=False)
        largest = int(np.bincount(group, minlength=1).argmax()) if count else 0
        seen = self._seen(bends.features, np.flatnonzero(group != largest), True, deadline)
        links = np.concatenate([np.empty((0, 2), dtype=np.int32), *seen])
        links = links[group[links[:, 0]] != group[links[:, 1]]]
        both = [_pairs_of(sight).astype(np.int32), links]
        return Bends(bends.features, sight_of(both, bends.features.position, bends.features, True))


@dataclass(frozen=True, eq=False)
class _Chains:
    """Chains of features between pairs of places; L pairs."""

    pairs: NDArray[np.int64]  # (L, 2)
    lengths: FloatArray  # (L,) m, infinite where there is none
    begin: NDArray[np.int64]  # (L,) where its features begin
    count: NDArray[np.int64]  # (L, 2) how many the shortest one has, and another one after it that may be shorter when taut
    features: NDArray[np.int64]

    @classmethod
    def none(cls) -> _Chains:
        """No chains."""
        none = np.empty(0, dtype=np.int64)
        return cls(none.reshape(0, 2), np.empty(0), none, none.reshape(0, 2), none)

    @classmethod
    def joined(cls, parts: list[_Chains]) -> _Chains:
        """All of them in one."""
        offsets = np.cumsum([0, *(len(part.features) for part in parts)])
        begins = [part.begin + offset for part, offset in zip(parts, offsets, strict=False)]
        columns = [
            (part.pairs, part.lengths, begin, part.count, part.features) for part, begin in zip(parts, begins, strict=True)
        ]
        return cls(*map(np.concatenate, zip(*columns, strict=True)))

    def split(self) -> tuple[_Chains, NDArray[np.int64]]:
        """Those that there are, and the pairs without one."""
        kept = np.isfinite(self.lengths)
        if kept.all():
            return self, self.pairs[:0]
        rest = _Chains(self.pairs[kept], self.lengths[kept], self.begin[kept], self.count[kept], self.features)
        return rest, self.pairs[~kept]


def _from_the_same(points: FloatArray, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (L, 2) of points, each begun at the end that its coordinates put first, so that no order of points matters."""
    rank = np.empty(len(points), dtype=np.int64)
    rank[np.lexsort(points.T)] = np.arange(len(points))
    turned = np.where((rank[pairs[:, 0]] > rank[pairs[:, 1]])[:, None], pairs[:, ::-1], pairs)
    return np.ascontiguousarray(turned[np.argsort(turned[:, 0], kind="stable")])


def _pairs_of(sight: Sight) -> NDArray[np.int64]:
    """Which features see each other, (S, 2), each pair once."""
    viewers = np.repeat(np.arange(len(sight.begin) - 1), np.diff(sight.begin))
    once = viewers < sight.feature
    return np.stack([viewers[once], sight.feature[once].astype(np.int64)], axis=1)


def _eased_of(eased: Eased, places: NDArray[np.int64]) -> Eased:
    """What some of the places need less of."""
    count = np.diff(eased.begin)[places]
    begin = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(count)])
    rows = np.arange(begin[-1]) + np.repeat(eased.begin[places] - begin[:-1], count)
    return Eased(begin, eased.obstacle[rows], eased.need[rows])
