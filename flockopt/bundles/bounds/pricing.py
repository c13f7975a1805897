"""The Lagrangian of a fleet's routes: what task prices prove, and the ascent that finds good prices.

Pay a price for every task served and let every drone fly the ng-route that is cheapest after its earnings; then
the prices plus what the drones make of them bound the travel of every allocation. For the best prices this is the
bound of the linear program over all ng-routes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.bundles.bounds.ng_route import Labels, Neighbourhood, cheapest_labels, count_visits, grow_labels, neighbourhood
from flockopt.bundles.bounds.polyak import LEAST_REACH, begin, seen, target
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["NEIGHBOURS", "DroneGroup", "ascend_prices", "evaluate", "group_drones", "grow", "travel_ceiling"]

#: Tasks in an ng-neighbourhood, itself included.
NEIGHBOURS = 8

#: Share of the new direction in a step; the rest is the last direction.
DIRECTION_SHARE = 0.5

#: A step is divided by the direction's squared norm, or by this share of the gradient's where that is more.
LEAST_NORM_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class DroneGroup:
    """Drones with one travel matrix and one end: their routes differ in their starts and capacities only.

    Attributes:
        drones: (n,) which drones.
        between: (M, M) m between tasks.
        near: The ng-neighbourhoods.
        starts: (n, M) m.
        ends: (M,) m from each task to the end.
        initial: (Q + 1, M) m of a route of one task by its load, infinite where there is none.
        demands: (M,) integers.
        capacities: (n,) at most Q.
        idle: (n,) m flown without tasks.
    """

    drones: NDArray[np.int64]
    between: FloatArray
    near: Neighbourhood
    starts: FloatArray
    ends: FloatArray
    initial: FloatArray
    demands: NDArray[np.int64]
    capacities: NDArray[np.int64]
    idle: FloatArray


def group_drones(scene: Scene, travel: Travel, size: int = NEIGHBOURS) -> list[DroneGroup]:
    """The fleet in groups that share labels; ``size`` tasks to a neighbourhood."""
    demands = scene.demands.astype(np.int64)
    capacities = np.minimum(scene.capacities, scene.demands.sum()).astype(np.int64)
    members: dict[tuple[int, bytes], list[int]] = {}
    for drone in range(scene.num_drones):
        members.setdefault((int(travel.drone_class[drone]), travel.task_end[drone].tobytes()), []).append(drone)
    matrices = [np.ascontiguousarray(matrix) for matrix in travel.task_task]
    near = [neighbourhood(matrix, size) for matrix in matrices]
    groups = []
    for (kind, _), drones in members.items():
        ends = travel.task_end[drones[0]]
        initial = np.full((capacities[drones].max() + 1, scene.num_tasks), np.inf)
        light = demands < len(initial)
        initial[demands[light], np.flatnonzero(light)] = ends[light]
        starts = np.ascontiguousarray(travel.start_task[drones])
        idle, carries = travel.start_end[drones], capacities[drones]
        groups.append(DroneGroup(np.array(drones), matrices[kind], near[kind], starts, ends, initial, demands, carries, idle))
    return groups


def travel_ceiling(travel: Travel) -> float:
    """Metres that no allocation exceeds: every task reached by its longest leg, every drone's longest way to its end.

    A bound above it shows that there is no allocation at all. Prices that rise no further stay free of rounding.
    """
    legs = np.concatenate([travel.start_task, *travel.task_task], axis=0)
    ends = np.column_stack([travel.task_end, travel.start_end])
    return sum(float(np.where(np.isfinite(part), part, 0.0).max(axis=axis).sum()) for part, axis in ((legs, 0), (ends, 1)))


def grow(group: DroneGroup, prices: FloatArray, initial: FloatArray | None = None) -> Labels:
    """The group's labels under task prices (M,), from ``initial`` if other than its own."""
    first = group.initial if initial is None else initial
    near = group.near
    return Labels(*grow_labels(group.between, near.order, first, prices, group.demands, near.position, near.carried))


def evaluate(groups: list[DroneGroup], prices: FloatArray) -> tuple[float, FloatArray]:
    """The bound that prices (M,) prove, metres, and how often the cheapest routes visit each task (M,)."""
    value, visits = float(prices.sum()), np.zeros(len(prices))
    for group in groups:
        labels = grow(group, prices)
        values, chosen = cheapest_labels(labels.first, labels.costs, group.starts, group.capacities, group.idle)
        count_visits(chosen, labels.fronts, labels.parents, visits)
        value += float(values.sum())
    return value, visits


def ascend_prices(
    groups: list[DroneGroup],
    prices: FloatArray,
    *,
    rounds: int,
    upper: float,
    cooling: float = 0.7,
    time_limit_s: float | None = None,
) -> FloatArray:
    """Better prices (M,) by a projected subgradient with Polyak steps to a moving target.

    Args:
        groups: The fleet.
        prices: (M,) to begin with, >= 0.
        rounds: Evaluations at most.
        upper: Travel of a known allocation, or infinity; no target lies above it.
        cooling: What the reach shrinks to; nearer to 1 ends nearer to the maximum, after more rounds.
        time_limit_s: Stops the ascent after the round in which it passes.
    """
    deadline = None if time_limit_s is None else time.monotonic() + time_limit_s
    best_prices, direction = prices, np.zeros_like(prices)
    ascent = begin()
    for step in range(rounds):
        value, visits = evaluate(groups, prices)
        if value > ascent.best:
            best_prices = prices
        ascent = seen(ascent, value, cooling, 0.0)
        gradient = 1.0 - visits
        steepest = gradient[(prices > 0.0) | (gradient > 0.0)]  # what would not leave the positive prices
        late = deadline is not None and time.monotonic() > deadline
        if not steepest.any() or ascent.reach < LEAST_REACH or late:
            break
        share = DIRECTION_SHARE if step else 1.0
        direction = share * gradient + (1.0 - share) * direction
        direction[(prices <= 0.0) & (direction < 0.0)] = 0.0
        norm = max(float(direction @ direction), LEAST_NORM_SHARE * float(steepest @ steepest))
        prices = np.maximum(0.0, prices + (target(ascent, upper) - value) / norm * direction)
    return best_prices
