"""The Lagrangian of a fleet's routes: what task prices prove, and the ascent that finds good prices.

Pay a price for every task served and let every drone fly the ng-route that is cheapest after its earnings; then
the prices plus what the drones make of them bound the travel of every allocation. For the best prices this is the
bound of the linear program over all ng-routes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.deadline import NEVER, Deadline, OutOfTime
from flockopt.bundles.bounds.ng_route import Labels, Neighbourhood, cheapest_labels, count_visits, grow_labels, neighbourhood
from flockopt.bundles.bounds.polyak import FIRST_REACH, LEAST_REACH, REACH, aim, begin
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = [
    "CLOSED_GAP",
    "NEIGHBOURS",
    "DroneGroup",
    "ascend",
    "ascend_prices",
    "drones_that_share",
    "evaluate",
    "evaluate_any_end",
    "group_drones",
    "grow",
    "route_loads",
    "travel_ceiling",
]

#: Tasks in an ng-neighbourhood, itself included.
NEIGHBOURS = 8

#: Share of the new direction in a step; the rest is the last direction.
DIRECTION_SHARE = 0.5

#: A step is divided by the direction's squared norm, or by this share of the gradient's where that is more.
LEAST_NORM_SHARE = 0.5

#: An allocation this share above a bound is as good as it gets.
CLOSED_GAP = 1e-7

#: Steps that aim at less than this part of a gap that is good enough are not worth making.
REACH_SHARE = 0.25

#: Labels grow for loads that have so many pairs of tasks at a time at least.
SLICE_PAIRS = 500_000


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


def drones_that_share(travel: Travel) -> list[list[int]]:
    """The drones of each group: those with one travel matrix and one end."""
    members: dict[tuple[int, bytes], list[int]] = {}
    for drone, kind in enumerate(travel.drone_class):
        members.setdefault((int(kind), travel.task_end[drone].tobytes()), []).append(drone)
    return list(members.values())


def route_loads(scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Demands (M,) and what each drone can carry of them (N,), in the largest unit that divides all demands."""
    demands = scene.demands.astype(np.int64)
    unit = max(int(np.gcd.reduce(demands)), 1)
    return demands // unit, np.minimum(scene.capacities, scene.demands.sum()).astype(np.int64) // unit


def group_drones(scene: Scene, travel: Travel, size: int = NEIGHBOURS) -> list[DroneGroup]:
    """The fleet in groups that share labels; ``size`` tasks to a neighbourhood."""
    demands, capacities = route_loads(scene)
    matrices = [np.ascontiguousarray(matrix) for matrix in travel.task_task]
    near = [neighbourhood(matrix, size) for matrix in matrices]
    groups = []
    for drones in drones_that_share(travel):
        kind, ends = travel.drone_class[drones[0]], travel.task_end[drones[0]]
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


def grow(group: DroneGroup, prices: FloatArray, initial: FloatArray | None = None, deadline: Deadline = NEVER) -> Labels:
    """The group's labels under task prices (M,), from ``initial`` if other than its own.

    Raises:
        OutOfTime: If the deadline passes.
    """
    start, near = group.initial if initial is None else initial, group.near
    num_loads, num = start.shape
    first, cheapest, room = np.zeros(num_loads * num + 1, np.int64), np.full(num_loads, np.inf), 64 * num
    labels = Labels(first, np.empty(room), *(np.empty(room, np.int64) for _ in range(3)))
    loads = 1 + SLICE_PAIRS // max(num * num, 1)
    for head, tail in deadline.slices(-(-num_loads // loads), "pricing routes"):
        load, last = head * loads, min(tail * loads, num_loads)
        while load < last:
            load = grow_labels(
                group.between, near.order, start, prices, group.demands, near.position, near.carried,
                load, last, first, cheapest, *labels[1:],
            )  # fmt: skip
            if load < last:
                labels = Labels(first, *(np.concatenate([array, np.empty_like(array)]) for array in labels[1:]))
    count = first[-1]
    return Labels(first, labels.costs[:count], labels.fronts[:count], labels.memories[:count], labels.parents[:count])


def evaluate(groups: list[DroneGroup], prices: FloatArray, deadline: Deadline = NEVER) -> tuple[float, FloatArray]:
    """The bound that prices (M,) prove, metres, and how often the cheapest routes visit each task (M,).

    Raises:
        OutOfTime: If the deadline passes.
    """
    value, visits, lasts = float(prices.sum()), np.zeros(len(prices)), np.zeros(len(prices))
    for group in groups:
        labels = grow(group, prices, deadline=deadline)
        values, chosen = group.idle.copy(), np.full(len(group.idle), -1)
        cheapest_labels(labels.first, labels.costs, group.starts, group.capacities, values, chosen)
        count_visits(chosen, labels.fronts, labels.parents, visits, lasts)
        value += float(values.sum())
    return value, visits


def evaluate_any_end(
    groups: list[DroneGroup], ends: FloatArray, idle: FloatArray, prices: FloatArray, deadline: Deadline = NEVER
) -> tuple[float, FloatArray]:
    """The bound of routes whose drones pay for any last leg, metres, and its slope along the prices (2 M,).

    Args:
        groups: Drones with one travel matrix each, as if without ends (`group_drones` of such a travel).
        ends: (N, M) m from each task to each end.
        idle: (N,) m flown without tasks.
        prices: (2 M,) m, of tasks, then what a drone earns where its route ends and pays where its last leg begins.
        deadline: When to stop.

    Raises:
        OutOfTime: If the deadline passes.
    """
    tasks, turns = np.split(prices, 2)
    visits, lasts, begun = np.zeros(len(tasks)), np.zeros(len(tasks)), np.zeros(len(tasks))
    legs = ends + turns
    first, leg = legs.argmin(axis=1), legs.min(axis=1)
    leg = np.where(np.isfinite(leg), leg, 0.0)
    value = float(tasks.sum())
    for group in groups:
        labels = grow(group, tasks, group.initial - turns, deadline)
        values, chosen = idle[group.drones] - leg[group.drones], np.full(len(group.drones), -1)
        cheapest_labels(labels.first, labels.costs, group.starts, group.capacities, values, chosen)
        count_visits(chosen, labels.fronts, labels.parents, visits, lasts)
        np.add.at(begun, first[group.drones[chosen >= 0]], 1.0)
        value += float((values + leg[group.drones]).sum())
    return value, np.concatenate([1.0 - visits, begun - lasts])


def ascend_prices(
    groups: list[DroneGroup],
    prices: FloatArray,
    *,
    rounds: int,
    upper: float,
    cooling: float = 0.7,
    good: float | FloatArray = CLOSED_GAP,
    reach: float = FIRST_REACH,
    deadline: Deadline = NEVER,
) -> tuple[float, FloatArray]:
    """Better prices (M,) of tasks, >= 0, for `evaluate`; for the rest see `ascend`."""

    def slope(prices: FloatArray) -> tuple[float, FloatArray]:
        value, visits = evaluate(groups, prices, deadline)
        return value, 1.0 - visits

    return ascend(slope, prices, np.zeros(len(prices)), rounds=rounds, upper=upper, cooling=cooling, good=good, reach=reach)


def ascend(
    slope: Callable[[FloatArray], tuple[float, FloatArray]],
    prices: FloatArray,
    least: FloatArray,
    *,
    rounds: int,
    upper: float,
    cooling: float = 0.7,
    good: float | FloatArray = CLOSED_GAP,
    reach: float = FIRST_REACH,
) -> tuple[float, FloatArray]:
    """Better prices by a projected subgradient with Polyak steps to a moving target.

    Args:
        slope: The bound that prices prove, metres, and its slope along them; `OutOfTime` from it ends the ascent.
        prices: (P,) to begin with.
        least: (P,) what they are not to fall below.
        rounds: Evaluations at most.
        upper: Travel of a known allocation, or infinity; no target lies above it.
        cooling: What the reach shrinks to; nearer to 1 ends nearer to the maximum, after more rounds.
        good: Ends it where ``upper`` is no farther above the bound than this share of it, or steps aim much less far; one for
            each round, or one for all.
        reach: The share by which the first target lies above the first value.

    Returns:
        The best bound, metres, and the prices (P,) that prove it; minus infinity if there was no time for any.
    """
    best, best_prices, direction = -math.inf, prices, np.zeros_like(prices)
    ascent = begin(reach)
    for step, near in enumerate(np.broadcast_to(good, rounds)):
        try:
            value, gradient = slope(prices)
        except OutOfTime:
            break
        if value > best:
            best, best_prices = value, prices
        goal = aim(ascent, value, cooling, 0.0, upper)
        steepest = gradient[(prices > least) | (gradient > 0.0)]  # what would not leave the prices that may be
        if not steepest.any() or ascent[REACH] < max(LEAST_REACH, REACH_SHARE * near) or upper <= best * (1.0 + near):
            break
        share = DIRECTION_SHARE if step else 1.0
        direction = share * gradient + (1.0 - share) * direction
        direction[(prices <= least) & (direction < 0.0)] = 0.0
        norm = max(float(direction @ direction), LEAST_NORM_SHARE * float(steepest @ steepest))
        prices = np.maximum(least, prices + (goal - value) / norm * direction)
    return best, best_prices
