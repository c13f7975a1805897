"""Compiled search for shortest paths over features, from one point to one or to several.

The graph is a tangent graph (Lozano-Perez and Wesley 1979; in space its nodes are samples of edges, since the best bend
may be anywhere on an edge): two features are joined where the line between them is clear and touches the obstacles of
both, for a shortest path is taut, and leaves an obstacle along a tangent and on the side it came round. Edges are looked
for only when a search gets to them, which checks a small part of them (a lazy A*; Hart, Nilsson and Raphael 1968).

Most blocked flights need a small detour: `within_ellipse` looks only at the features in an ellipse around the
straight flight, and a path it finds is shortest because any way that leaves the ellipse is longer. What is left
goes to `shortest`, one search over all features to all remaining targets, which remembers what features see.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.records.arrays import FloatArray
from flockopt.travel.blocking import blocker
from flockopt.travel.frontier import SETTLED, Frontier, empty_frontier, offer, take_least
from flockopt.travel.sight import HIDDEN, SEEN, UNKNOWN, Sight, Step, View, look_around, norm, sees, step, tangent, wraps

__all__ = ["shortest", "within_ellipse"]

#: More features than this in an ellipse, or more of them settled, and the pair is left to the wider search.
MOST_MEMBERS, MOST_SETTLED = 256, 48


class Ellipse(NamedTuple):
    """The features around a straight flight, and how far a search over them has come."""

    members: NDArray[np.int64]  # (M,) which features
    to_target: FloatArray  # (M,) m, straight
    distance: FloatArray  # (M,) m, from the source by the best path so far, or straight where it may be seen from there
    settled: NDArray[np.bool_]  # (M,)
    parent: NDArray[np.int64]  # (F,) the feature before each, -1 if it is reached from the source


class Search(NamedTuple):
    """How far a search over all F features has come."""

    frontier: Frontier
    distance: FloatArray  # (F,) m, from the source by the best path so far
    estimate: FloatArray  # (F,) m, straight to the nearest target
    parent: NDArray[np.int64]  # (F,) as in `Ellipse`


@compiled_lazily(error_model="numpy")
def within_ellipse(
    view: View, source: int, target: int, from_source: FloatArray, bound: float, parent: NDArray[np.int64]
) -> tuple[float, int]:
    """A shortest path over features v with ``|source v| + |v target| < bound``.

    Args:
        view: Points and features; what points are known to see is filled further.
        source: Index of the point to start from.
        target: Index of the point to reach.
        from_source: (F,) m, distance of each feature from the source.
        bound: Metres.
        parent: (F,) filled with the feature before each settled feature, -1 if it is reached from the source.

    Returns:
        Its length and last feature; (inf, -1) if there is none shorter than ``bound`` or it is not found soon.
    """
    ellipse = Ellipse(
        np.empty(MOST_MEMBERS, dtype=np.int64), np.empty(MOST_MEMBERS), np.empty(MOST_MEMBERS),
        np.zeros(MOST_MEMBERS, dtype=np.bool_), parent,
    )  # fmt: skip
    size = _gather(view, source, target, from_source, bound, ellipse)
    if size < 0:
        return np.inf, -1
    features, seen, num_obstacles, best = view.features, view.seen, view.space.table.shape[0], bound
    last, guess = -1, np.int64(-1)
    for _ in range(MOST_SETTLED):
        key = best
        nearest = -1
        # among so few a linear scan is faster than a heap
        for m in range(size):
            if not ellipse.settled[m] and ellipse.distance[m] + ellipse.to_target[m] < key:
                nearest, key = m, ellipse.distance[m] + ellipse.to_target[m]
        if nearest < 0:
            return (best, last) if last >= 0 else (np.inf, -1)
        u = ellipse.members[nearest]
        if parent[u] < 0 and seen[source, u] == UNKNOWN:
            # its distance was a guess: whether the source sees it is asked only now that it would be next
            found = sees(view, source, u, guess)
            if found >= 0:
                ellipse.distance[nearest] = np.inf
                guess = found if found < num_obstacles else guess
                continue
        ellipse.settled[nearest] = True
        come = _arrival(view, source, parent, u)
        go = step(features.position, u, view.points, target)
        if wraps(features, u, come, go) and sees(view, target, u, guess) < 0:
            best, last = key, u
        else:
            guess = _relax_ellipse(view, source, ellipse, size, nearest, best, guess)
    return np.inf, -1


@compiled_lazily(error_model="numpy")
def _gather(view: View, source: int, target: int, from_source: FloatArray, bound: float, ellipse: Ellipse) -> int:
    """Fill the ellipse with its members; return how many there are, -1 if too many."""
    position, points, seen, size = view.features.position, view.points, view.seen, 0
    for v in range(position.shape[0]):
        if from_source[v] >= bound:
            continue
        dx, dy, dz = step(position, v, points, target)
        away, rest = dx * dx + dy * dy + dz * dz, bound - from_source[v]
        if away < rest * rest:
            if size == MOST_MEMBERS:
                return -1
            ellipse.members[size], ellipse.to_target[size] = v, math.sqrt(away)
            # a feature not known to be hidden from the source may be as near as the straight line
            ellipse.distance[size] = np.inf if seen[source, v] == HIDDEN else from_source[v]
            ellipse.parent[v] = -1
            size += 1
    return size


@compiled_lazily(error_model="numpy")
def _arrival(view: View, source: int, parent: NDArray[np.int64], u: int) -> Step:
    """The step by which the best path so far comes to feature u."""
    position = view.features.position
    if parent[u] < 0:
        return step(view.points, source, position, u)
    return step(position, parent[u], position, u)


@compiled_lazily(error_model="numpy")
def _relax_ellipse(view: View, source: int, ellipse: Ellipse, size: int, nearest: int, best: float, guess: int) -> int:
    """Shorten the ways to other members by those through the settled one ``nearest``; return who blocked last."""
    space, features, seen, parent = view.space, view.features, view.seen, ellipse.parent
    position = features.position
    u = ellipse.members[nearest]
    come = _arrival(view, source, parent, u)
    for m in range(size):
        if ellipse.settled[m]:
            continue
        v = ellipse.members[m]
        go = step(position, u, position, v)
        length = ellipse.distance[nearest] + norm(go)
        if length + ellipse.to_target[m] >= best or (ellipse.distance[m] <= length and seen[source, v] != UNKNOWN):
            continue
        if not (tangent(features, u, go) and tangent(features, v, go) and wraps(features, u, come, go)):
            continue
        if parent[v] < 0 and seen[source, v] == UNKNOWN:
            if sees(view, source, v, guess) < 0:  # straight from the source is shorter than through u
                continue
            ellipse.distance[m] = np.inf
        elif parent[v] < 0 and seen[source, v] == SEEN:
            continue
        found = blocker(space, position[u], position[v], guess)
        if found < 0:
            ellipse.distance[m], parent[v] = length, u
        else:
            guess = found
    return guess


@compiled_lazily(error_model="numpy")
def shortest(
    view: View, sight: Sight, source: int, targets: NDArray[np.int64], best: FloatArray, last: NDArray[np.int64],
    parent: NDArray[np.int64],
) -> Sight:  # fmt: skip
    """Shortest paths from one point to several, over features.

    A* with the distance to the nearest target as the estimate, which is never too long; a feature is expanded only if a
    path through it could still beat the best known one to some target.

    Args:
        view: Points and features; what points are known to see is filled further.
        sight: What is known of which features see each other; filled further.
        source: Index of the point to start from.
        targets: (T,) indices of the points to reach.
        best: (T,) m, upper bounds on the lengths (infinite where none is known); lowered here.
        last: (T,) the last feature before each target; left as it is where no shorter path is found.
        parent: (F,) filled with the feature before each settled feature, -1 if it is reached from the source.

    Returns:
        The sight, with its pool grown where needed.
    """
    num_features = view.features.position.shape[0]
    frontier, distance = empty_frontier(num_features), np.full(num_features, np.inf)
    search = Search(frontier, distance, np.zeros(num_features), parent)
    worst = best.max()
    _set_out(view, source, targets, worst, search)
    while frontier.size[0] > 0:
        u = take_least(frontier)
        if frontier.key[u] >= worst:
            break
        come = _arrival(view, source, parent, u)
        useful, improved = _reach(view, u, come, distance[u], targets, best, last)
        if improved:
            worst = best.max()
        if useful:
            if sight.begin[u] < 0:
                sight = look_around(view, sight, u)
            _relax(view, sight, u, come, worst, search)
    return sight


@compiled_lazily(error_model="numpy")
def _set_out(view: View, source: int, targets: NDArray[np.int64], worst: float, search: Search) -> None:
    """Estimate all features' ways to go, and offer those that the source sees."""
    points, position, num_obstacles = view.points, view.features.position, view.space.table.shape[0]
    guess = -1
    for v in range(position.shape[0]):
        near = np.inf
        for target in targets:
            dx, dy, dz = step(position, v, points, target)
            near = min(near, dx * dx + dy * dy + dz * dz)
        search.estimate[v] = math.sqrt(near)
        length = norm(step(points, source, position, v))
        if length + search.estimate[v] >= worst:
            continue
        found = sees(view, source, v, guess)
        if found < 0:
            search.distance[v], search.parent[v] = length, -1
            offer(search.frontier, v, length + search.estimate[v])
        elif found < num_obstacles:
            guess = found


@compiled_lazily(error_model="numpy")
def _reach(
    view: View, u: int, come: Step, so_far: float, targets: NDArray[np.int64], best: FloatArray,
    last: NDArray[np.int64],
) -> tuple[bool, bool]:  # fmt: skip
    """Go on straight from feature u to every target; whether a way through u may be the shortest to any, and whether it is."""
    features, points, num_obstacles = view.features, view.points, view.space.table.shape[0]
    useful, improved, guess = False, False, np.int64(-1)
    for t in range(targets.shape[0]):
        go = step(features.position, u, points, targets[t])
        length = so_far + norm(go)
        if length < best[t]:
            useful = True
            if wraps(features, u, come, go):
                found = sees(view, targets[t], u, guess)
                if found < 0:
                    best[t], last[t], improved = length, u, True
                elif found < num_obstacles:
                    guess = found
    return useful, improved


@compiled_lazily(error_model="numpy")
def _relax(view: View, sight: Sight, u: int, come: Step, worst: float, search: Search) -> None:
    """Shorten the ways to the features that the settled feature u sees."""
    features, pool, frontier = view.features, sight.pool, search.frontier
    position = features.position
    distance, estimate, parent, place = search.distance, search.estimate, search.parent, frontier.place
    x, y, z, so_far = position[u, 0], position[u, 1], position[u, 2], distance[u]  # read once: this is the busiest loop
    for entry in range(sight.begin[u], sight.end[u]):
        v = np.int64(pool[entry])  # so that what follows is compiled for one type of index
        if place[v] == SETTLED:
            continue
        go = position[v, 0] - x, position[v, 1] - y, position[v, 2] - z
        length = so_far + norm(go)
        if length >= distance[v] or length + estimate[v] >= worst:
            continue
        if wraps(features, u, come, go):
            distance[v], parent[v] = length, u
            offer(frontier, v, length + estimate[v])
