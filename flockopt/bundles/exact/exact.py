"""Optimal allocations with proof: prices on tasks, every route worth flying under them, the best choice of routes.

1. Prices of tasks rise by subgradient to the bound L of all ng-routes (`pricing`): the dual of column generation,
   without a list of columns.
2. Every elementary route whose slack under these prices is at most U - L is listed (`enumeration`), where U is the
   travel of the best allocation known. An allocation better than U uses no other route.
3. HiGHS picks the cheapest choice among them, with cuts and branch and bound (`route_program`).

Where that list would be long, or no U is known, step 2 lists the routes within a smaller gap first: a choice that
comes out below L + gap is optimal all the same, and what else is found lowers U. `ExactResult.bound` is the vector
of step 1, which anyone can check; `ExactResult.proven` may lie above it, by the listing and the branch and bound, and
it is what the status ``"optimal"`` stands on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from flockopt.batches.deadline import Deadline, OutOfTime, heard
from flockopt.bundles import Bound, Bundles
from flockopt.bundles.bounds.bounds import first_prices, forest_bound, is_judged
from flockopt.bundles.bounds.pricing import DroneGroup, ascend_prices, group_drones, travel_ceiling
from flockopt.bundles.exact.enumeration import Pool, enumerate_routes, idle_costs
from flockopt.bundles.exact.route_program import RouteRules, choose_routes
from flockopt.bundles.explain import LENGTH_TOLERANCE_M, explained
from flockopt.bundles.search.anneal import default_iterations, search
from flockopt.bundles.search.construct import build_problem
from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["OPTIMAL_GAP", "ExactResult", "solve_exact"]

#: An allocation is optimal if no other is shorter by more than this share.
OPTIMAL_GAP = 1e-7

#: Dynamic programs solved for the prices, and how slowly their steps shrink.
ROUNDS, COOLING = 150, 0.8

#: The first list holds the routes within this share of the bound at most; the next gaps are so many times wider.
FIRST_GAP_SHARE, GAP_GROWTH = 0.03, 4.0

#: A gap with too many routes in it is divided by this.
OVERFLOW_SHRINK = 1.5

#: A gap in which nothing is left to be found, metres.
LEAST_GAP_M = 1e-6

#: Tails, and routes, on the first list and on any list, at most.
FIRST_ROUTES, MOST_ROUTES = 50_000, 200_000

#: Share of a time limit that the search for a first allocation may take.
SEARCH_SHARE = 0.2


@dataclass(frozen=True)
class ExactResult:
    """The best allocation found and what is known of it.

    Attributes:
        bundles: The allocation.
        bound: A bound that its vector proves.
        proven: The bound that all of the work proves, metres: the travel of optimal bundles; infinite where it is
            proven that no allocation serves all tasks.
        status: That of the bundles: ``"optimal"``, ``"feasible"`` or ``"incomplete"`` (out of time or
            room), or ``"infeasible"``.
    """

    bundles: Bundles
    bound: Bound
    proven: float
    status: Status


def solve_exact(
    scene: Scene, travel: Travel, *, warm_start: Bundles | None = None, time_limit_s: float | None = None, seed: int = 0
) -> ExactResult:
    """The allocation of least travel, with proof as far as the time goes.

    Args:
        scene: Whose capacities, demands and longest routes count.
        travel: Distances, metres.
        warm_start: An allocation to begin with.
        time_limit_s: None for as long as it takes.
        seed: Of the search for a first allocation.

    Raises:
        MissingExtra: If highspy is not installed.
        SettingsError: If the time limit is negative or not a number.
        SolverFailed: If HiGHS fails.
    """
    if time_limit_s is not None and not time_limit_s >= 0.0:
        raise SettingsError("time_limit_s", f"is {time_limit_s!r}", "must be seconds >= 0 or None", "raise it")
    deadline = Deadline.after(time_limit_s)
    best = _first_allocation(scene, travel, warm_start, time_limit_s, seed)
    upper = math.inf if best.status != Status.FEASIBLE else travel.total(best.routes)
    if not scene.num_tasks:
        best = replace(best, status=Status.OPTIMAL if upper < math.inf else best.status)
        return ExactResult(best, forest_bound(scene, travel, rounds=0), upper, best.status)
    forested = forest_bound(scene, travel, rounds=0)
    if not is_judged(scene, travel):  # too many loads and tasks to list routes by
        return ExactResult(best, forested, forested.value, best.status)
    ceiling = min(upper, travel_ceiling(travel))
    groups, prices = group_drones(scene, travel), first_prices(scene, travel, ceiling, deadline)
    value, prices = ascend_prices(groups, prices, rounds=ROUNDS, upper=ceiling, cooling=COOLING, deadline=deadline)
    if value == -math.inf:  # no time for one round
        return ExactResult(best, forested, forested.value, best.status)
    best, proven = _Lists(scene, travel, groups, prices, value, ceiling, deadline).close(best, upper)
    if proven == math.inf and best.status == Status.INCOMPLETE:
        words = "no allocation serves all tasks, and that is proven: all routes were listed"
        reasons = "; ".join([words, *(reason for _, reason in best.unserved)])
        best = replace(best, status=Status.INFEASIBLE, reason=reasons)
    return ExactResult(best, Bound("ng-route", value, prices), proven, best.status)


def _first_allocation(
    scene: Scene, travel: Travel, warm_start: Bundles | None, time_limit_s: float | None, seed: int
) -> Bundles:
    """What a short search finds; only its construction where there is no time."""
    routes = search(
        build_problem(scene, travel),
        warm_start=() if warm_start is None else warm_start.routes,
        iterations=default_iterations(scene.num_tasks) if time_limit_s != 0.0 else 0,
        time_limit_s=SEARCH_SHARE * time_limit_s if time_limit_s else None,
        seed=seed,
    )
    return explained(scene, travel, routes)


@dataclass(frozen=True, eq=False)
class _Lists:
    """Lists of routes within growing gaps over one bound, until one of them holds the optimum for sure."""

    scene: Scene
    travel: Travel
    groups: list[DroneGroup]
    prices: FloatArray  # (M,) m
    value: float  # m, the bound they prove
    ceiling: float  # m, what the best allocation does not exceed if there is one
    deadline: Deadline

    def close(self, best: Bundles, upper: float) -> tuple[Bundles, float]:
        """The best allocation, labelled, and the bound proven for it, metres; ``upper`` is the travel of ``best``."""
        proven, too_wide, limit = self.value, math.inf, FIRST_ROUTES
        searched = 0.0  # no allocation below `upper` has routes of no more slack than this only
        longest = np.array([math.inf if drone.max_distance is None else drone.max_distance for drone in self.scene.drones])
        longest += LENGTH_TOLERANCE_M
        fleet = RouteRules(self.scene.demands, self.scene.capacities, ~(self.travel.start_end <= longest))
        widest = (1.0 + OPTIMAL_GAP) * self.ceiling - self.value  # all that an allocation can use
        gap = min(widest, max(FIRST_GAP_SHARE * abs(proven), LEAST_GAP_M))
        while widest >= 0.0 and not _closed(upper, proven) and not self.deadline.is_over:
            try:
                listing = partial(enumerate_routes, self.groups, self.prices, gap, longest, limit)
                pool = heard(listing, deadline=self.deadline, doing="listing routes")
            except OutOfTime:
                break
            if pool is None:
                too_wide, gap = gap if limit == MOST_ROUTES else math.inf, gap / OVERFLOW_SHRINK
                if gap < LEAST_GAP_M:
                    break
                continue
            limit = MOST_ROUTES
            routes, bound = self._choose(pool, fleet, searched, upper)
            if routes is not None:
                best, upper = Bundles(routes), self.travel.total(routes)
                widest = upper - self.value
            elif gap >= widest and bound == upper == math.inf:
                return best, math.inf
            proven = max(proven, min(bound, self.value + gap, upper))
            wider = min(widest, GAP_GROWTH * gap)
            if not gap < wider < too_wide:
                break
            searched, gap = gap if bound >= upper * (1.0 - OPTIMAL_GAP) else 0.0, wider
        if upper < math.inf and _closed(upper, proven):
            return replace(best, status=Status.OPTIMAL), upper
        return best, proven if widest >= 0.0 else math.inf

    def _choose(
        self, pool: Pool, fleet: RouteRules, searched: float, upper: float
    ) -> tuple[tuple[tuple[int, ...], ...] | None, float]:
        """The cheapest routes in the pool, None unless they beat ``upper``, and a bound on all others in it, metres."""
        if not len(pool):
            return None, math.inf
        idle_m = sum(float(idle_costs(group).sum()) for group in self.groups)
        target = upper * (1.0 - OPTIMAL_GAP / 2.0) - idle_m
        choice = choose_routes(pool, fleet, self.prices, searched, target, self.deadline)
        if choice.routes is None:
            return None, choice.bound + idle_m
        routes: list[tuple[int, ...]] = [()] * self.scene.num_drones
        for route in choice.routes:
            routes[pool.drones[route]] = tuple(int(task) for task in pool.tasks[route] if task >= 0)
        return (tuple(routes) if self.travel.total(routes) < upper else None), choice.bound + idle_m


def _closed(upper: float, proven: float) -> bool:
    return proven >= upper * (1.0 - OPTIMAL_GAP)
