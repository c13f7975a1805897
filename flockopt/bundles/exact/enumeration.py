"""Enumeration of every route that an allocation better than a known one can use.

Under prices with bound L, an allocation of travel z uses routes whose slacks (cost less earnings, above the least
the drone can have) add up to z - L. So the routes of slack below U - L hold every allocation better than U. Tails of
routes grow from the end; one that no start can complete within the gap is dropped with all that would grow from it,
and of tails over the same tasks and with the same first one only the shortest can be part of a shortest route.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.bundles.bounds.ng_route import cheapest_labels
from flockopt.bundles.bounds.pricing import DroneGroup, grow
from flockopt.bundles.exact.tails import Tails, grow_tails, match_starts, trace_tails
from flockopt.records.arrays import FloatArray

__all__ = ["Pool", "enumerate_routes", "idle_costs"]

#: Slack lost to rounding, metres: routes this far beyond the gap are still kept.
ROUNDING_M = 1e-9


@dataclass(frozen=True, eq=False)
class Pool:
    """Routes, the shortest of each drone and set of tasks.

    Attributes:
        drones: (R,) who flies it.
        costs: (R,) m travelled, less what the drone flies idle.
        tasks: (R, K) in visiting order, -1 after the last.
    """

    drones: NDArray[np.int64]
    costs: FloatArray
    tasks: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.drones)

    def take(self, chosen: NDArray) -> Pool:
        """The routes of an index array or a mask."""
        return Pool(self.drones[chosen], self.costs[chosen], self.tasks[chosen])


def enumerate_routes(groups: list[DroneGroup], prices: FloatArray, gap: float, longest: FloatArray, limit: int) -> Pool | None:
    """Every elementary route of slack at most ``gap`` under prices (M,), or None where there are too many.

    Args:
        groups: The fleet.
        prices: (M,) m.
        gap: Metres; infinite for all routes.
        longest: (N,) m that each drone may fly at most, infinite for any.
        limit: Tails, and routes, at most.
    """
    parts = []
    for group in groups:
        labels = grow(group, prices)
        earned = group.idle.copy()
        cheapest_labels(labels.first, labels.costs, group.starts, group.capacities, earned, np.empty(len(earned), np.int64))
        completions, slack = _completions(group, prices, earned), gap + ROUNDING_M
        tails = Tails(*grow_tails(group.between, group.initial, prices, group.demands, completions, slack, limit))
        if len(tails.fronts) > limit:
            return None
        reach = longest[group.drones]
        rows, ends = match_starts(*tails[:4], group.starts, earned, group.capacities, reach, slack, limit)
        if len(rows) > limit:
            return None
        lengths = group.starts[rows, tails.fronts[ends]] + tails.lengths[ends]
        kept = _shortest(rows, tails.sets[ends], lengths)
        tasks = trace_tails(ends[kept], tails.fronts, tails.parents)
        parts.append(Pool(group.drones[rows[kept]], (lengths - idle_costs(group)[rows])[kept], tasks))
    return _joined(parts)


def idle_costs(group: DroneGroup) -> FloatArray:
    """(n,) m of flying without tasks; 0 for a drone that cannot, since it must fly with some."""
    return np.where(np.isfinite(group.idle), group.idle, 0.0)


def _completions(group: DroneGroup, prices: FloatArray, earned: FloatArray) -> FloatArray:
    """(Q + 1, M) m: the least slack that a drone and the tasks before it add to a tail, by its load and first task."""
    most, tasks = len(group.initial) - 1, np.arange(len(prices))
    initial = np.full((most + 1, len(prices)), np.inf)
    for row, capacity in enumerate(group.capacities):
        # The load of a head counts from what the group's largest drone can carry more than its own.
        loads = most - capacity + group.demands
        fits = loads <= most
        at = (loads[fits], tasks[fits])
        initial[at] = np.minimum(initial[at], group.starts[row, fits] - earned[row])
    labels = grow(group, prices, initial)
    best = np.full((most + 1) * len(prices), np.inf)
    filled = labels.first[:-1] < labels.first[1:]
    best[filled] = labels.costs[labels.first[:-1][filled]]
    best = np.minimum.accumulate(best.reshape(most + 1, len(prices)), axis=0)
    room = np.clip(most - np.arange(most + 1)[:, None] + group.demands[None], 0, most)
    return best[room, tasks[None]] + prices


def _shortest(rows: NDArray[np.int64], sets: NDArray[np.int64], lengths: FloatArray) -> NDArray[np.int64]:
    """Indices of the shortest of each drone's routes over one set of tasks."""
    order = np.lexsort((lengths, *sets.T, rows))
    fresh = np.ones(len(order), dtype=np.bool_)
    fresh[1:] = (np.diff(rows[order]) != 0) | (np.diff(sets[order], axis=0) != 0).any(axis=1)
    return order[fresh]


def _joined(parts: list[Pool]) -> Pool:
    width = max(part.tasks.shape[1] for part in parts)
    padded = [np.pad(part.tasks, ((0, 0), (0, width - part.tasks.shape[1])), constant_values=-1) for part in parts]
    drones, costs = (np.concatenate([getattr(part, field) for part in parts]) for field in ("drones", "costs"))
    return Pool(drones, costs, np.concatenate(padded))
