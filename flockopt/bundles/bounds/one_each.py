"""The best allocation where no drone carries more than one task, and the prices that prove it: an assignment problem.

Its linear program has integral vertices, so there is no gap between the two; the prices prove the kind ``ng-route``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["OneEach", "carries_one_at_most", "match_one_each"]


@dataclass(frozen=True, eq=False)
class OneEach:
    """A task a drone at most.

    Attributes:
        routes: N tuples of one task or none.
        prices: (M,) m, what serving each task earns.
    """

    routes: tuple[tuple[int, ...], ...]
    prices: FloatArray


def carries_one_at_most(scene: Scene) -> bool:
    """Whether even the two lightest tasks are too much for any drone."""
    return scene.num_tasks == 1 or bool(np.sort(scene.demands)[:2].sum() > scene.capacities.max())


def match_one_each(scene: Scene, travel: Travel, longest: FloatArray | float = np.inf) -> OneEach | None:
    """The cheapest way to give every task a drone of its own; None if there is none.

    Args:
        scene: Whose capacities and demands count.
        travel: Distances, metres.
        longest: (N,) m that each drone may travel.
    """
    from scipy.optimize import linear_sum_assignment

    routes = travel.start_task + travel.task_end  # (N, M) m
    limit = np.broadcast_to(longest, scene.num_drones)[:, None]
    able = (scene.demands <= scene.capacities[:, None]) & (routes <= limit) & np.isfinite(routes)
    idle = np.where(np.isfinite(travel.start_end), travel.start_end, 0.0)
    costs = np.where(able, routes - idle[:, None], np.inf)
    if scene.num_tasks > scene.num_drones:
        return None
    try:
        drones, tasks = linear_sum_assignment(costs)
    except ValueError:  # no way to serve all of them
        return None
    chosen: list[tuple[int, ...]] = [()] * scene.num_drones
    for drone, task in zip(drones, tasks, strict=True):
        chosen[drone] = (int(task),)
    return OneEach(tuple(chosen), _prices(costs, drones, tasks))


def _prices(costs: FloatArray, drones: np.ndarray, tasks: np.ndarray) -> FloatArray:
    """(M,) prices that prove an assignment optimal: shortest ways in the graph of exchanges (Bellman, Ford).

    What a drone loses by its task is what it would save others by taking over one of theirs; one without a task loses nothing.
    """
    losses = np.zeros(len(costs))  # of drones, at most 0
    extra = costs[:, tasks] - costs[drones, tasks]  # (N, M) m, for taking over from the drone that serves the task
    for _ in range(len(tasks)):
        better = np.minimum(losses, (extra + losses[drones]).min(axis=1))
        if (better == losses).all():
            break
        losses = better
    prices = np.empty(len(tasks))
    prices[tasks] = costs[drones, tasks] - losses[drones]
    return np.maximum(prices, 0.0)
