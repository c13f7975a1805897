"""Whether an allocation is the best there is: every route that a better one could use is listed anew, then chosen among.

Task prices prove a bound L (the kind ``ng-route``). An allocation of travel below V uses only routes whose slacks, their cost
less what they earn above the least that their drone can have, add up to less than V - L; so each of them is below V - L too.
Few routes are, where prices are good. They are listed by depth-first search from each start, cut where even the cheapest rest
of an ng-route would be too dear, and HiGHS (as scipy has it) chooses the cheapest of them that serve each task once. Shares no
code with `flockopt.bundles.exact`, which lists from the ends and chooses with cuts of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, compiled_for
from flockopt.batches.deadline import heard
from flockopt.errors import PlanError, SolverFailed
from flockopt.records.arrays import FloatArray

__all__ = ["Offers", "least_travel"]

#: Routes listed, and steps of the search for them, at most: enough for 20 drones and 60 tasks under good prices.
MOST_ROUTES, MOST_STEPS = 100_000, 20_000_000

#: Branches of the choice among them at most: what is proven by then counts, so that no plan keeps its judge for long.
MOST_BRANCHES = 10_000

#: Slack lost to rounding, metres: routes this far beyond are listed too.
ROUNDING_M = 1e-6

#: The chosen routes may come out this share below the claim: sums in another order.
ROUNDING_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class Offers:
    """What one drone can do under the prices.

    Attributes:
        starts: (M,) m to each task.
        between: (M, M) m between tasks.
        ends: (M,) m from each task to its end.
        rests: (Q + 1, M) m, the least priced cost of an ng-route from its first task on, by load at most and first task.
        capacity: At most Q.
        idle: Metres flown without tasks; infinite where it must fly with some.
        longest: Metres it may fly at most.
    """

    starts: FloatArray
    between: FloatArray
    ends: FloatArray
    rests: FloatArray
    capacity: int
    idle: float
    longest: float

    @property
    def least(self) -> float:
        """What it makes of the prices at best, metres."""
        return min(self.idle, float((self.starts + self.rests[self.capacity]).min()))

    @property
    def may_idle(self) -> bool:
        """Whether it can stay without tasks."""
        return self.idle <= self.longest and np.isfinite(self.idle)


def least_travel(offers: list[Offers], prices: FloatArray, demands: NDArray[np.int64], claim: float) -> float:
    """What no allocation travels less than: the claim if no allocation beats it, less otherwise; metres.

    Args:
        offers: Of every drone.
        prices: (M,) m, what serving each task earns, >= 0.
        demands: (M,) of the tasks.
        claim: Metres.

    Raises:
        PlanError: If the claim is no number, or there are too many routes to list.
        SolverFailed: If HiGHS fails.
    """
    if np.isnan(claim):
        raise PlanError("value", "is not a number", "must be metres", "give the travel that is claimed to be the least")
    bound = float(prices.sum()) + sum(offer.least for offer in offers)
    if not np.isfinite(bound) or bound >= claim:
        return min(bound, claim)
    routes = list(_routes(offers, prices, demands, claim - bound + ROUNDING_M))
    idle = sum(offer.idle for offer in offers if offer.may_idle)
    chosen = idle + _cheapest_cover(routes, offers, len(prices))
    return claim if chosen >= claim * (1.0 - ROUNDING_SHARE) else max(bound, chosen)


#: A drone, the tasks on its route as bits of an integer, and what that route costs more than idling, metres.
Route = tuple[int, int, float]


def _routes(offers: list[Offers], prices: FloatArray, demands: NDArray[np.int64], gap: float) -> Iterator[Route]:
    """The shortest route of each drone over each set of tasks, if its slack is within the gap."""
    room, steps = MOST_ROUTES, MOST_STEPS
    for drone, offer in enumerate(offers):
        shortest: dict[int, float] = {}
        given = offer.starts, offer.between, offer.ends, offer.rests, prices, demands, offer.capacity
        limits = offer.least + gap, offer.longest, room, steps
        tasks, lengths, count, taken = heard(partial(_list_routes, *given, *limits))
        if count < 0:
            rule = f"at most {MOST_ROUTES} routes may lie between its prices and its value"
            raise PlanError("dual", "proves too little to recheck", rule, 'claim the bound of its prices: kind "ng-route"')
        room, steps = room - count, steps - taken
        for row, length in zip(tasks[:count], lengths[:count], strict=True):
            members = sum(1 << int(task) for task in row if task >= 0)
            if length < shortest.get(members, np.inf):
                shortest[members] = float(length)
        idle = offer.idle if offer.may_idle else 0.0
        yield from ((drone, members, length - idle) for members, length in shortest.items())


def _cheapest_cover(routes: list[Route], offers: list[Offers], num_tasks: int) -> float:
    """The least cost of routes that serve each task once, one a drone at most, as HiGHS bounds it; infinite without any."""
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csc_array

    if not routes:
        return np.inf
    rows = [[task for task in range(num_tasks) if members >> task & 1] + [num_tasks + drone] for drone, members, _ in routes]
    first = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    shape = (num_tasks + len(offers), len(routes))
    serves = csc_array((np.ones(first[-1]), np.concatenate(rows), first), shape=shape)
    must_fly = [float(not offer.may_idle) for offer in offers]
    limits = LinearConstraint(serves, np.concatenate([np.ones(num_tasks), must_fly]), 1.0)
    # HiGHS's presolve has returned wrong optima before (frozen in tests/oracle/test_exact_oracle.py)
    costs = np.array([cost for *_, cost in routes])
    effort = {"presolve": False, "mip_rel_gap": 0.0, "node_limit": MOST_BRANCHES}
    answer = heard(
        lambda: milp(costs, integrality=np.ones(len(routes)), bounds=Bounds(0.0, 1.0), constraints=limits, options=effort)
    )
    if answer.status == 2:  # infeasible
        return np.inf
    if answer.status not in (0, 1) or answer.mip_dual_bound is None:  # optimal, or out of branches
        raise SolverFailed("HiGHS (scipy)", answer.message)
    return float(answer.mip_dual_bound)


@compiled_for(
    FLOATS_1, FLOATS_2, FLOATS_1, FLOATS_2, FLOATS_1, INTEGERS_1, types.int64, types.float64, types.float64, types.int64,
    types.int64, nogil=True,
)  # fmt: skip
def _list_routes(
    starts: FloatArray, between: FloatArray, ends: FloatArray, rests: FloatArray, prices: FloatArray,
    demands: NDArray[np.int64], capacity: int, most_cost: float, longest: float, most_routes: int, most_steps: int,
) -> tuple[NDArray[np.int16], FloatArray, int, int]:  # fmt: skip
    """Routes (R, K) of one drone whose priced cost is at most ``most_cost``, -1 after the last task, and their metres (R,).

    The third is their number, -1 where a limit is passed; the fourth is how many steps that took. Depth first:
    ``tried[depth]`` is the task that is looked at next there. What is flown up to a task, priced without it, and the
    cheapest rest from it on bound every route through it.
    """
    num = len(starts)
    routes, lengths = np.full((64, max(capacity, 1)), -1, np.int16), np.empty(64)
    path, tried = np.empty(capacity + 1, np.int64), np.zeros(capacity + 1, np.int64)
    load, flown, earned = np.zeros(capacity + 1, np.int64), np.zeros(capacity + 1), np.zeros(capacity + 1)
    on_route = np.zeros(num, np.bool_)
    depth, count, steps = 0, 0, 0
    while depth >= 0:
        task = tried[depth]
        tried[depth] += 1
        if task >= num:
            depth -= 1
            if depth >= 0:
                on_route[path[depth]] = False
            continue
        left = capacity - load[depth]
        if on_route[task] or demands[task] > left:
            continue
        steps += 1
        if steps > most_steps:
            return routes, lengths, -1, steps
        there = flown[depth] + (starts[task] if depth == 0 else between[path[depth - 1], task])
        if not there <= longest or not there - earned[depth] + rests[left, task] <= most_cost:
            continue
        path[depth], on_route[task] = task, True
        if there + ends[task] <= longest and there + ends[task] - earned[depth] - prices[task] <= most_cost:
            if count >= most_routes:
                return routes, lengths, -1, steps
            if count == len(routes):
                more, longer = np.full((2 * count, routes.shape[1]), -1, np.int16), np.empty(2 * count)
                more[:count], longer[:count] = routes, lengths
                routes, lengths = more, longer
            for place in range(depth + 1):
                routes[count, place] = path[place]
            lengths[count] = there + ends[task]
            count += 1
        depth += 1
        tried[depth] = 0
        load[depth], flown[depth] = load[depth - 1] + demands[task], there
        earned[depth] = earned[depth - 1] + prices[task]
    return routes, lengths, count, steps
