"""Lower bounds on the fleet's travel, each with the vector that proves it.

``fast`` is a spanning forest, ``tight`` the same under Held-Karp prices, ``exact`` the Lagrangian of all ng-routes, the
bound that a proof of optimality starts from. A bound holds for every allocation that
serves all tasks within the capacities, so it is claimed of feasible scenes; where a relaxation by itself shows that
there is no such allocation (tasks cut off from every start), its value is infinite, the least cost over nothing.
The value is computed once more from the final vector, so that whoever recomputes it finds the same.
"""

from __future__ import annotations

import math

import numpy as np

from flockopt.bundles import Bound
from flockopt.bundles.bounds import forest
from flockopt.bundles.bounds.pricing import ascend_prices, evaluate, group_drones, travel_ceiling
from flockopt.bundles.bundles import BOUND_EFFORTS
from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["held_karp_bound", "lower_bound", "ng_route_bound", "rooted_forest_bound"]

#: Spanning trees grown for the Held-Karp bound: within 0.03 % of its limit from 10 x 20 to 100 x 1000.
HELD_KARP_ROUNDS = 60

#: Dynamic programs solved for the ng-route bound: within 0.05 % of its limit from 10 x 20 to 20 x 100.
NG_ROUNDS = 80


def lower_bound(scene: Scene, travel: Travel, *, bound: str = "tight", upper: float | None = None) -> Bound:
    """A proven lower bound on the travel of every feasible allocation.

    Args:
        scene: Whose capacities and demands count.
        travel: Distances, metres.
        bound: ``"fast"`` (rooted forest), ``"tight"`` (Held-Karp forest) or ``"exact"`` (ng-routes).
        upper: Travel of a known allocation, metres; steers the ascent, proves nothing.

    Raises:
        SettingsError: If ``bound`` is unknown or ``upper`` is negative or not a number.
    """
    if bound not in BOUND_EFFORTS:
        raise SettingsError("bound", f"is {bound!r}", f"must be one of {', '.join(BOUND_EFFORTS)}", "choose one")
    if upper is not None and not upper >= 0.0:
        raise SettingsError("upper", f"is {upper!r}", "must be metres >= 0 or None", "give the travel of a known allocation")
    return _BOUNDS[bound](scene, travel, math.inf if upper is None else upper)


def rooted_forest_bound(scene: Scene, travel: Travel, upper: float = math.inf) -> Bound:
    """The cheapest spanning tree of the tasks and one super-root; needs no vector."""
    starts, between = _forest_costs(scene, travel)
    value = forest.forest_value(starts, between, np.zeros(scene.num_tasks), np.zeros(scene.num_drones))
    return Bound("rooted-forest", value, np.empty(0))


def held_karp_bound(scene: Scene, travel: Travel, upper: float = math.inf, rounds: int = HELD_KARP_ROUNDS) -> Bound:
    """The rooted forest under prices on a task's third neighbour (M,) and on a start's second route (N,)."""
    starts, between = _forest_costs(scene, travel)
    dual = forest.ascend(starts, between, rounds, min(upper, travel_ceiling(travel)))
    value = forest.forest_value(starts, between, *np.split(dual, [scene.num_tasks]))
    return Bound("held-karp-forest", value, dual)


def ng_route_bound(scene: Scene, travel: Travel, upper: float = math.inf, rounds: int = NG_ROUNDS) -> Bound:
    """The Lagrangian of all ng-routes within the capacities; its vector is a price for each task (M,)."""
    if not scene.num_tasks:
        return Bound("ng-route", 0.0, np.empty(0))
    upper = min(upper, travel_ceiling(travel))
    groups, prices = group_drones(scene, travel), first_prices(scene, travel, upper)
    prices = ascend_prices(groups, prices, rounds=rounds, upper=upper)
    return Bound("ng-route", evaluate(groups, prices)[0], prices)


def first_prices(scene: Scene, travel: Travel, upper: float = math.inf) -> FloatArray:
    """Prices of tasks (M,) that prove about the Held-Karp bound when routes are priced with them."""
    starts, between = _forest_costs(scene, travel)
    dual = forest.ascend(starts, between, HELD_KARP_ROUNDS, upper)
    shares = forest.task_shares(starts, between, *np.split(dual, [scene.num_tasks]))
    return np.where(np.isfinite(shares), np.maximum(0.0, shares), 0.0)


def _forest_costs(scene: Scene, travel: Travel) -> tuple[FloatArray, FloatArray]:
    """(N, M) from starts, infinite where a task outweighs the drone, and (M, M) between tasks, least over classes."""
    fits = scene.demands[None, :] <= scene.capacities[:, None]
    starts = np.where(fits, travel.start_task, np.inf)
    between = travel.task_task[0] if len(travel.task_task) == 1 else travel.task_task.min(axis=0)
    return starts, np.ascontiguousarray(between)


_BOUNDS = dict(zip(BOUND_EFFORTS, (rooted_forest_bound, held_karp_bound, ng_route_bound), strict=True))
