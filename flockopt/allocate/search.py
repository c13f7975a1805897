"""Ruin-and-recreate search under simulated annealing: the allocation that `refine_bundles` finds by default."""

from __future__ import annotations

import math
from time import perf_counter

import numpy as np

from flockopt.allocate.search_construct import insert_by_regret, insert_routes
from flockopt.allocate.search_moves import recreate, ruin
from flockopt.allocate.search_state import (
    NUM_WAITING,
    IntArray,
    Problem,
    Routes,
    commit,
    compiled,
    empty_routes,
    random_unit,
    undo,
)
from flockopt.geometry import FloatArray

__all__ = ["default_iterations", "search"]

#: Temperatures that annealing starts and ends with, as shares of the first solution's travel per task.
FIRST_HEAT, LAST_HEAT = 0.1, 0.001

#: How many tasks a ruin takes on average.
MEAN_RUINED = 10.0

#: Under a time limit: iterations before the clock is read first, and share of the time between later readings.
FIRST_ITERATIONS, CLOCK_SHARE = 32, 0.04

#: Iterations for every task where neither iterations nor a time limit are asked for.
ITERATIONS_A_TASK = 150

#: A new best solution is one better by this many metres.
IMPROVEMENT_M = 1e-9


def default_iterations(num_tasks: int) -> int:
    """How many iterations a search runs that was given no limit: enough to be near the best it finds at all."""
    return ITERATIONS_A_TASK * num_tasks


def search(
    problem: Problem,
    *,
    warm_start: tuple[tuple[int, ...], ...] = (),
    preference: FloatArray | None = None,
    iterations: int | None = None,
    time_limit_s: float | None = None,
    seed: int = 0,
) -> tuple[tuple[int, ...], ...]:
    """The best routes found, task indices by drone; tasks that fit nowhere are on none of them.

    Args:
        problem: From `search_construct.build_problem`.
        warm_start: Routes to begin with; what does not fit is inserted anew.
        preference: (M, N) m, added to the travel of serving task j by drone i while the first solution is made.
        iterations: How many times to ruin and recreate; equal seeds and iterations give equal routes.
        time_limit_s: When to stop, in place of or ahead of ``iterations``.
        seed: Of the search's own generator.
    """
    began = perf_counter()
    routes = empty_routes(problem, seed)
    insert_routes(problem, routes, warm_start)
    insert_by_regret(problem, routes, np.empty((0, 0)) if preference is None else preference)
    commit(routes)
    best_after = routes.after.copy()
    if iterations is None and time_limit_s is None:
        iterations = default_iterations(len(problem.demand))
    if len(problem.demand) and (time_limit_s is None or perf_counter() - began < time_limit_s):
        _cool_down(problem, routes, best_after, iterations, time_limit_s, began)
    return _extract(problem, best_after)


def _cool_down(
    problem: Problem, routes: Routes, best_after: IntArray, iterations: int | None, time_limit_s: float | None, began: float
) -> None:
    """Anneal in stretches short enough to keep the time limit, colder as iterations or time run out."""
    num_tasks, best_cost = len(problem.demand), total_cost(problem, routes)
    served = num_tasks - routes.counters[NUM_WAITING]
    heat = (best_cost - problem.penalty * routes.counters[NUM_WAITING]) / max(served, 1)
    done, step, share = 0, FIRST_ITERATIONS, 0.0
    stretch_began = perf_counter()
    while share < 1.0:
        if time_limit_s is None:
            assert iterations is not None
            step = iterations
        elif iterations is not None:
            step = min(step, iterations - done)
        temperature = heat * FIRST_HEAT * (LAST_HEAT / FIRST_HEAT) ** share
        cooling = 1.0 if time_limit_s is not None else (LAST_HEAT / FIRST_HEAT) ** (1.0 / max(step, 1))
        best_cost = anneal(problem, routes, best_after, best_cost, step, temperature, cooling, MEAN_RUINED)
        done += step
        now = perf_counter()
        share = 0.0 if iterations is None else done / max(iterations, 1)
        if time_limit_s is not None:
            share = max(share, (now - began) / time_limit_s)
            pace = step / max(now - stretch_began, 1e-9)
            step = max(1, int(pace * min(CLOCK_SHARE * time_limit_s, max(time_limit_s - (now - began), 0.0))))
        stretch_began = now


def _extract(problem: Problem, after: IntArray) -> tuple[tuple[int, ...], ...]:
    """Routes from their links, cut where a leg has no way."""
    num_tasks, routes = len(problem.demand), []
    for drone, kind in enumerate(problem.drone_class):
        tasks, node = [], num_tasks + drone
        while after[node] < num_tasks and problem.distance[kind, node, after[node]] < problem.no_way:
            node = int(after[node])
            tasks.append(node)
        if tasks and problem.distance[kind, node, num_tasks + drone] >= problem.no_way:
            tasks = []
        routes.append(tuple(tasks))
    return tuple(routes)


@compiled
def total_cost(problem: Problem, routes: Routes) -> float:
    """Travel of all drones plus the penalty of every unserved task, metres; sets every drone's length anew."""
    num_tasks = len(problem.demand)
    total = problem.penalty * routes.counters[NUM_WAITING]
    for drone in range(len(problem.capacity)):
        kind, node, length = problem.drone_class[drone], num_tasks + drone, 0.0
        while True:
            following = routes.after[node]
            length += problem.distance[kind, node, following]
            node = following
            if node >= num_tasks:
                break
        routes.length[drone] = length
        total += length
    return total


@compiled
def anneal(
    problem: Problem, routes: Routes, best_after: IntArray, best_cost: float,
    iterations: int, temperature: float, cooling: float, mean_ruined: float,
) -> float:  # fmt: skip
    """Ruin and recreate; returns the best cost and leaves its links in ``best_after``."""
    cost = total_cost(problem, routes)
    for _ in range(iterations):
        num_waited = routes.counters[NUM_WAITING]
        change = ruin(problem, routes, mean_ruined) + recreate(problem, routes, num_waited)
        change += problem.penalty * (routes.counters[NUM_WAITING] - num_waited)
        if change < -temperature * math.log(random_unit(routes.random)):
            commit(routes)
            cost += change
            if cost < best_cost - IMPROVEMENT_M:
                best_cost = cost
                for node in range(len(best_after)):
                    best_after[node] = routes.after[node]
        else:
            undo(problem, routes)
        temperature *= cooling
    return best_cost
