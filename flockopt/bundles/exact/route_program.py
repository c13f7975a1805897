"""The program that picks routes from a pool: every task once, every drone at most one route.

Its linear relaxation is tightened by cuts while there are any; then branch and bound takes the routes of least slack,
as many as it can do quickly. What is left to be found after that has one of the other routes: with this rule as one
more row the relaxation goes on, until its bound shows that nothing is left. HiGHS holds a part of the pool, to which
routes are added as its duals ask for them. The relaxation's bounds are recomputed here from the duals over the whole
pool, never read from the solver; branch and bound is taken at its word.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.deadline import Deadline
from flockopt.bundles.exact.cuts import Cuts, no_cuts, violated_cuts
from flockopt.bundles.exact.enumeration import Pool
from flockopt.bundles.exact.highs import HighsProgram, Solution
from flockopt.errors import SolverFailed
from flockopt.records.arrays import FloatArray

__all__ = ["Choice", "RouteRules", "choose_routes"]

#: Cuts added in a round at most, and rounds.
CUTS_PER_ROUND, CUT_ROUNDS = 60, 40

#: Routes in the first linear program, and added to it in a round, at most.
FIRST_ROUTES, MORE_ROUTES = 1500, 500

#: Routes in the first branch and bound at most; each further one takes so many times more.
BRANCHED_ROUTES, BRANCHED_GROWTH = 400, 1.6

#: Shares of routes nearer to an integer than this are one, and reduced costs above minus this are none, metres.
INTEGRALITY, PRICE_TOLERANCE_M = 1e-6, 1e-7


@dataclass(frozen=True, eq=False)
class RouteRules:
    """What a choice of routes has to keep, besides each drone's own limits.

    Attributes:
        demands: (M,) of the tasks.
        capacities: (N,) of the drones.
        must_fly: (N,) drones that cannot stay idle.
    """

    demands: FloatArray
    capacities: FloatArray
    must_fly: NDArray[np.bool_]


@dataclass(frozen=True)
class Choice:
    """What a pool offers.

    Attributes:
        bound: No choice costs less, unless it costs more than was asked for; metres above idle flying.
        routes: Indices of the cheapest choice found, or None.
    """

    bound: float
    routes: NDArray[np.int64] | None


def choose_routes(
    pool: Pool, fleet: RouteRules, prices: FloatArray, least_slack: float, upper: float, deadline: Deadline
) -> Choice:
    """The cheapest routes that serve every task once.

    Args:
        pool: Routes to choose from, at least one.
        fleet: Whose demands and capacities the routes keep.
        prices: (M,) m, under which the pool was listed.
        least_slack: Only choices with a route of more slack under these prices are asked for, metres.
        upper: Only choices cheaper than this are asked for, metres above idle flying; may be infinite.
        deadline: When to stop.

    Raises:
        MissingExtra: If highspy is not installed.
        SolverFailed: If HiGHS fails.
    """
    relaxation = _Relaxation(pool, fleet, prices, least_slack, deadline)
    best, most, rounds = None, BRANCHED_ROUTES, 0
    while True:
        shares = relaxation.solve()
        if shares is None or relaxation.bound >= upper or deadline.is_over:
            return Choice(min(relaxation.bound, upper), best)
        used = np.flatnonzero(shares > INTEGRALITY)
        if (shares[used] > 1.0 - INTEGRALITY).all():
            _check_choice(pool.take(used), fleet)
            return Choice(relaxation.bound, used)
        order = np.argsort(relaxation.slacks, kind="stable")
        needed = order[: np.searchsorted(relaxation.slacks[order], upper - relaxation.bound, side="right")]
        if len(needed) > most and rounds < CUT_ROUNDS and relaxation.cut(used, shares[used]):
            rounds += 1
            continue
        solution = relaxation.integer_program(needed[:most]).solve_integer(upper, deadline.left_s)
        if solution.values is not None:
            chosen = needed[:most][solution.values > 0.5]
            _check_choice(pool.take(chosen), fleet)
            if pool.costs[chosen].sum() < upper:
                best, upper = chosen, float(pool.costs[chosen].sum())
        if solution.status == "stopped":
            return Choice(min(relaxation.bound, upper), best)
        if len(needed) <= most:
            return Choice(upper, best)
        relaxation.require_one(np.setdiff1d(order, needed[:most]))
        most, rounds = int(BRANCHED_GROWTH * most), 0


def _check_choice(routes: Pool, fleet: RouteRules) -> None:
    """Raise a `SolverFailed` unless these routes serve every task once and every drone flies one at most."""
    served = np.bincount(routes.tasks[routes.tasks >= 0], minlength=len(fleet.demands))
    flown = np.bincount(routes.drones, minlength=len(fleet.capacities))
    if (served != 1).any() or (flown > 1).any() or (flown[fleet.must_fly] < 1).any():
        raise SolverFailed("HiGHS", "its choice of routes leaves a task out, or serves or flies something twice")


class _Relaxation:
    """The linear relaxation over a pool and what its last duals prove."""

    def __init__(self, pool: Pool, fleet: RouteRules, prices: FloatArray, least_slack: float, deadline: Deadline) -> None:
        self.pool, self.fleet, self.deadline = pool, fleet, deadline
        self.num_tasks, self.num_rows = len(prices), len(prices) + len(fleet.must_fly)
        self.cuts = no_cuts(len(pool))
        self.bound, self.slacks = self._prove(np.append(prices, np.zeros(len(fleet.must_fly))))
        if least_slack > 0.0:
            self.cuts = Cuts((self.slacks > least_slack)[None], np.ones(1), np.full(1, np.inf))
        order = np.argsort(self.slacks, kind="stable")
        split = int(np.searchsorted(self.slacks[order], least_slack, side="right")) if least_slack > 0.0 else 0
        self.held = np.concatenate([order[:split][:FIRST_ROUTES], order[split:][:FIRST_ROUTES]])
        self.program = self.integer_program(self.held)

    def integer_program(self, routes: NDArray[np.int64]) -> HighsProgram:
        """Rows for tasks, then drones, then cuts; columns for these routes."""
        lower = np.concatenate([np.ones(self.num_tasks), self.fleet.must_fly, self.cuts.lower])
        upper = np.concatenate([np.ones(self.num_rows), self.cuts.upper])
        return HighsProgram(self.pool.costs[routes], *self._entries(routes), lower, upper)

    def solve(self) -> FloatArray | None:
        """(R,) shares of the routes, and ``bound`` and ``slacks`` anew; None where there are none or no time is left."""
        while True:
            solution = self.program.solve_linear(self.deadline.left_s)
            if solution.status == "stopped":
                return None
            wanted = self._wanted(solution)
            if not len(wanted):
                break
            self.held = np.concatenate([self.held, wanted])
            self.program.add_columns(self.pool.costs[wanted], *self._entries(wanted))
        if solution.values is None:
            self.bound = math.inf
            return None
        shares = np.zeros(len(self.pool))
        shares[self.held] = solution.values
        return shares

    def cut(self, used: NDArray[np.int64], shares: FloatArray) -> bool:
        """Add the cuts that these shares of the routes ``used`` break most; false where there are none."""
        found = violated_cuts(self.pool.tasks, used, shares, self.fleet.demands, self.fleet.capacities, CUTS_PER_ROUND)
        self.program.add_rows(found.members[:, self.held], found.lower, found.upper)
        self.cuts = self.cuts.joined(found)
        return len(found.lower) > 0

    def require_one(self, routes: NDArray[np.int64]) -> None:
        """Ask from now on for choices with at least one of these routes."""
        members = np.zeros((1, len(self.pool)), dtype=np.bool_)
        members[0, routes] = True
        row = Cuts(members, np.ones(1), np.full(1, np.inf))
        self.program.add_rows(members[:, self.held], row.lower, row.upper)
        self.cuts = self.cuts.joined(row)

    def _wanted(self, solution: Solution) -> NDArray[np.int64]:
        """Routes outside the program that would improve it; the next by slack where it has no solution at all."""
        outside = np.ones(len(self.pool), dtype=np.bool_)
        outside[self.held] = False
        if solution.values is None:
            return np.flatnonzero(outside)[np.argsort(self.slacks[outside], kind="stable")[: len(self.held)]]
        bound, slacks = self._prove(solution.duals)
        if bound > self.bound:
            self.bound, self.slacks = bound, slacks
        drone_prices = solution.duals[self.num_tasks : self.num_rows]
        gains = self._margins(solution.duals) - drone_prices[self.pool.drones]
        wanted = np.flatnonzero(outside & (gains < -PRICE_TOLERANCE_M))
        return wanted[np.argsort(gains[wanted], kind="stable")[:MORE_ROUTES]]

    def _prove(self, duals: FloatArray) -> tuple[float, FloatArray]:
        """What the duals prove, whatever they are, and each route's slack (R,) above the least of its drone."""
        margins = self._margins(duals)
        least = np.where(self.fleet.must_fly, np.inf, 0.0)
        np.minimum.at(least, self.pool.drones, margins)
        cut_prices = self._cut_prices(duals)
        limits = np.where(cut_prices < 0.0, self.cuts.upper, self.cuts.lower)
        priced = cut_prices != 0.0
        earned = duals[: self.num_tasks].sum() + cut_prices[priced] @ limits[priced]
        return float(earned + least.sum()), margins - least[self.pool.drones]

    def _margins(self, duals: FloatArray) -> FloatArray:
        """(R,) m, cost less the prices of tasks and cuts."""
        prices = np.append(duals[: self.num_tasks], 0.0)  # the last one is for the padding
        cut_prices = self._cut_prices(duals)
        priced = np.flatnonzero(cut_prices)
        return self.pool.costs - prices[self.pool.tasks].sum(axis=1) - cut_prices[priced] @ self.cuts.members[priced]

    def _cut_prices(self, duals: FloatArray) -> FloatArray:
        """(T,) duals of the cuts, those of the wrong sign read as 0: a cut has one limit, and it is all that it proves."""
        prices = duals[self.num_rows :]
        one_sided = np.where(np.isfinite(self.cuts.upper), np.minimum(prices, 0.0), np.maximum(prices, 0.0))
        return one_sided if len(prices) else np.zeros(len(self.cuts.lower))

    def _entries(self, routes: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Where each column starts (R + 1,) and the rows it has a one in."""
        cut_rows = np.where(self.cuts.members[:, routes].T, self.num_rows + np.arange(len(self.cuts.lower)), -1)
        drone_rows = self.num_tasks + self.pool.drones[routes, None]
        rows = np.concatenate([self.pool.tasks[routes], drone_rows, cut_rows], axis=1)
        starts = np.concatenate([[0], np.cumsum((rows >= 0).sum(axis=1))])
        return starts.astype(np.int32), rows[rows >= 0].astype(np.int32)
