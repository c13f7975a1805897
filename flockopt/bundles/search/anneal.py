"""Ruin-and-recreate search under simulated annealing: the allocation that `refine_bundles` finds by default."""

from __future__ import annotations

import math
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numba import types

from flockopt.batches.compiled import compiled_for, record_of
from flockopt.batches.deadline import NEVER, SLICE_S
from flockopt.bundles.request import RouteTuple
from flockopt.bundles.search.construct import build_routes
from flockopt.bundles.search.matching import MATCHING, Matching, match_tails, matching_scratch
from flockopt.bundles.search.moves import recreate, ruin
from flockopt.bundles.search.state import (
    INDICES_1,
    NUM_WAITING,
    OPTIONS,
    PROBLEM,
    ROUTES,
    IntArray,
    Problem,
    Routes,
    adopt,
    commit,
    random_unit,
    total_cost,
    undo,
)
from flockopt.records.arrays import FloatArray

__all__ = ["default_iterations", "search"]

#: Temperatures that annealing starts and ends with, as shares of the first solution's travel per task. The last part
#: of the search begins again at the best solution and accepts next to nothing that is worse.
FIRST_HEAT, LAST_HEAT, FINAL_HEAT = 0.6, 0.2, 0.001
FINAL_SHARE = 0.1

#: How many tasks a ruin takes on average, and how often tails are matched after they are put back; and the same where there are
#: so many tasks that a ruin is small beside the whole.
MEAN_RUINED, MATCH_SHARE = 6.0, 0.5
MANY_TASKS, MEAN_RUINED_OF_MANY, MATCH_SHARE_OF_MANY = 300, 10.0, 1.0

#: How often a place is overlooked on purpose when tasks are put back, at least; times the number of tasks, so often where there
#: are so few that a ruin takes all of them, and they would go back the same few ways.
BLINK_SHARE, BLINKS = 0.01, 0.5

#: Under a time limit: iterations before the clock is read first, and share of the time between later readings.
FIRST_ITERATIONS, CLOCK_SHARE = 32, 0.04

#: Iterations before an interrupt from the keyboard is heard first.
FIRST_SLICE = 1000

#: What it does, for those who give it a deadline.
DOING = "sharing out the tasks"

#: Iterations for every task where neither iterations nor a time limit are asked for: about half a millisecond.
ITERATIONS_A_TASK = 150

#: A new best solution is one better by this many metres.
IMPROVEMENT_M = 1e-9


class Stretch(NamedTuple):
    """A stretch of annealing; temperatures in metres."""

    iterations: int
    temperature: float
    cooling: float  # factor on the temperature at every iteration
    mean_ruined: float
    blink_share: float
    match_share: float
    from_best: bool  # whether it begins at the best solution


#: The same as compiled code knows it.
STRETCH = record_of(Stretch, types.int64, *[types.float64] * 5, types.boolean)


def default_iterations(num_tasks: int) -> int:
    """How many iterations a search runs that was given no limit: enough to be near the best it finds at all."""
    return ITERATIONS_A_TASK * num_tasks


def search(
    problem: Problem,
    *,
    warm_start: RouteTuple = (),
    preference: FloatArray | None = None,
    iterations: int | None = None,
    time_limit_s: float | None = None,
    seed: int = 0,
) -> RouteTuple:
    """The best routes found, task indices by drone; tasks that fit nowhere are on none of them.

    Args:
        problem: From `search_construct.build_problem`.
        warm_start: Routes to begin with; what does not fit is inserted anew.
        preference: (M, N) m, added to the travel of serving task j by drone i while the first solution is made.
        iterations: How many times to ruin and recreate; equal seeds and iterations give equal routes.
        time_limit_s: When to stop, in place of or ahead of ``iterations``.
        seed: Of the search's own generator.
    """
    clock = _Clock(iterations, time_limit_s, len(problem.demand))
    detour = np.empty((0, 0)) if preference is None else preference
    annealer = _Annealer(problem, *build_routes(problem, warm_start, detour, seed))
    annealer.run(clock, 0.0, 1.0 - FINAL_SHARE, FIRST_HEAT, LAST_HEAT)
    annealer.return_to_best()
    annealer.run(clock, 1.0 - FINAL_SHARE, 1.0, FINAL_HEAT, FINAL_HEAT)
    return _extract(problem, annealer.best_after)


class _Clock:
    """Tells how much of a search is over, and how many iterations to run before it is asked again."""

    def __init__(self, iterations: int | None, time_limit_s: float | None, num_tasks: int) -> None:
        if iterations is None and time_limit_s is None:
            iterations = default_iterations(num_tasks)
        self.is_timed = time_limit_s is not None
        self._limit_s = math.inf if time_limit_s is None else time_limit_s
        self._iterations = math.inf if iterations is None else iterations
        self._began = self._asked = perf_counter()
        self._done = self._step = 0

    def share(self) -> float:
        """The share of the search that is over."""
        if self._iterations == 0:
            return 1.0
        return max(self._done / self._iterations, (perf_counter() - self._began) / self._limit_s)

    def step(self, until: float) -> int:
        """Iterations of the next stretch, which is to end where the share is ``until`` at the latest."""
        now = perf_counter()
        step = self._iterations * until - self._done
        if self.is_timed:
            pace = self._step / max(now - self._asked, 1e-9)
            seconds = min(CLOCK_SHARE * self._limit_s, SLICE_S, until * self._limit_s - (now - self._began))
            step = min(step, pace * seconds if self._done else FIRST_ITERATIONS)
        self._asked, self._step = now, max(1, math.ceil(step))
        self._done += self._step
        return self._step


class _Annealer:
    """A solution being annealed, and the best one seen."""

    def __init__(self, problem: Problem, routes: Routes, cost: float) -> None:
        self._problem, self._routes, self._matching = problem, routes, matching_scratch()
        num_waiting = routes.counters[NUM_WAITING]
        self.best_after, self._best_cost, self._from_best = routes.after.copy(), cost, False
        travel, num_served = self._best_cost - problem.penalty * num_waiting, len(problem.demand) - num_waiting
        self._scale = travel / max(num_served, 1)
        self._blink_share = max(BLINK_SHARE, BLINKS / max(len(problem.demand), 1))
        is_many = len(problem.demand) > MANY_TASKS
        self._mean_ruined = MEAN_RUINED_OF_MANY if is_many else MEAN_RUINED
        self._match_share = MATCH_SHARE_OF_MANY if is_many else MATCH_SHARE

    def run(self, clock: _Clock, begin: float, end: float, first_heat: float, last_heat: float) -> None:
        """Anneal until the share ``end`` of the search is over, colder all the time."""
        while (share := clock.share()) < end:
            step = clock.step(end)
            temperature = self._scale * first_heat * (last_heat / first_heat) ** ((share - begin) / (end - begin))
            cooling = 1.0 if clock.is_timed else (last_heat / first_heat) ** (1.0 / step)
            cost = math.nan
            for first, last in NEVER.slices(step, DOING, FIRST_SLICE):
                rates = self._mean_ruined, self._blink_share, self._match_share
                stretch = Stretch(last - first, temperature, cooling, *rates, self._from_best)
                state = self._problem, self._routes, self._matching, self.best_after
                cost, self._best_cost, temperature = _anneal(*state, cost, self._best_cost, stretch)
                self._from_best = False

    def return_to_best(self) -> None:
        """Go on from the best solution, if at all."""
        self._from_best = True


def _extract(problem: Problem, after: IntArray) -> RouteTuple:
    """Routes from their links, cut where a leg has no way."""
    num_tasks, routes = len(problem.demand), []
    following, leg_m = after.tolist(), problem.distance.item
    for drone, kind in enumerate(problem.drone_class.tolist()):
        tasks, node = [], num_tasks + drone
        while following[node] < num_tasks and leg_m(kind, node, following[node]) < problem.no_way:
            node = following[node]
            tasks.append(node)
        if tasks and leg_m(kind, node, num_tasks + drone) >= problem.no_way:
            tasks = []
        routes.append(tuple(tasks))
    return tuple(routes)


@compiled_for(PROBLEM, ROUTES, MATCHING, INDICES_1, types.float64, types.float64, STRETCH, **OPTIONS)
def _anneal(
    problem: Problem,
    routes: Routes,
    matching: Matching,
    best_after: IntArray,
    known_cost: float,
    best_cost: float,
    stretch: Stretch,
) -> tuple[float, float, float]:
    """Ruin, recreate, match; leaves the best solution's links in ``best_after``.

    ``known_cost`` is what the solution costs, not a number where that is to be summed up. Returns what it costs in the end, the
    best cost, and the temperature that was come to.
    """
    if stretch.from_best:
        adopt(problem, routes, best_after)
    cost, temperature = known_cost, stretch.temperature
    if stretch.from_best or np.isnan(cost):
        cost = total_cost(problem, routes)
    for _ in range(stretch.iterations):
        num_waited = routes.counters[NUM_WAITING]
        change = ruin(problem, routes, stretch.mean_ruined)
        change += recreate(problem, routes, num_waited, stretch.blink_share)
        change += problem.penalty * (routes.counters[NUM_WAITING] - num_waited)
        if change < -temperature * math.log(random_unit(routes.random)):
            commit(routes)
            cost += change
        else:
            undo(problem, routes)
        if random_unit(routes.random) < stretch.match_share:
            cost += match_tails(problem, routes, matching)
        if cost < best_cost - IMPROVEMENT_M:
            best_cost = cost
            for node in range(len(best_after)):
                best_after[node] = routes.after[node]
        temperature *= stretch.cooling
    return cost, best_cost, temperature
