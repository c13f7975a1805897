"""Bundles by OR-Tools' routing solver: parallel cheapest insertion, then guided local search.

OR-Tools counts in integers: every distance goes through `in_units`, which rounds up, so that a route within
``max_distance`` there is within it here; costs are recomputed in metres from the matrix.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.deadline import Deadline
from flockopt.bundles.request import RouteTuple
from flockopt.errors import SolverFailed, require
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["in_units", "route_with_ortools"]

#: Units of a metre that distances are counted in.
UNITS_PER_METRE = 10_000

#: Where there is no way, and what leaving a task out costs: more than any route, less than a leg without a way.
NO_WAY, LEFT_OUT = 10**13, 10**11

#: Milliseconds of search at least: less may end without any solution.
LEAST_MS = 100

#: Seconds of search where neither a time nor a number of solutions is given.
DEFAULT_SECONDS = 1.0


def in_units(metres: FloatArray) -> NDArray[np.int64]:
    """Distances as integers, rounded up; infinite ones become `NO_WAY`."""
    finite = np.where(np.isfinite(metres), metres, 0.0)
    return np.where(np.isfinite(metres), np.ceil(finite * UNITS_PER_METRE - 1e-6).astype(np.int64), NO_WAY)


def route_with_ortools(
    scene: Scene,
    travel: Travel,
    *,
    warm_start: RouteTuple = (),
    solutions: int | None = None,
    time_limit_s: float | None = None,
) -> RouteTuple:
    """Routes of little travel within capacities and ``max_distance``; tasks that fit nowhere are left out.

    Args:
        scene: The scene.
        travel: Its distances.
        warm_start: Routes to begin with, one a drone, or none.
        solutions: Stop after so many improving solutions: the same answer on every machine.
        time_limit_s: Stop after so many seconds; 1 where neither limit is given.

    Raises:
        MissingExtra: If OR-Tools is not installed.
        SolverFailed: If it finds no solution, which leaving tasks out always makes possible.
    """
    deadline = Deadline.after(DEFAULT_SECONDS if time_limit_s is None and solutions is None else time_limit_s)
    pywrapcp: Any = require("ortools.constraint_solver.pywrapcp", extra="solvers")
    enums: Any = require("ortools.constraint_solver.routing_enums_pb2", extra="solvers")
    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    starts = [num_tasks + drone for drone in range(num_drones)]
    ends = [num_tasks + num_drones + drone for drone in range(num_drones)]
    manager = pywrapcp.RoutingIndexManager(num_tasks + 2 * num_drones, num_drones, starts, ends)
    model = pywrapcp.RoutingModel(manager)
    lengths = [model.RegisterTransitMatrix(_matrix(scene, travel, kind).tolist()) for kind in range(len(travel.task_task))]
    by_drone = [lengths[kind] for kind in travel.drone_class]
    for drone, evaluator in enumerate(by_drone):
        model.SetArcCostEvaluatorOfVehicle(evaluator, drone)
    demands = [*scene.demands.astype(int).tolist(), *[0] * (2 * num_drones)]
    model.AddDimensionWithVehicleCapacity(
        model.RegisterUnaryTransitVector(demands), 0, scene.capacities.astype(int).tolist(), True, "load"
    )
    longest = [
        NO_WAY - 1 if drone.max_distance is None else int(drone.max_distance * UNITS_PER_METRE) for drone in scene.drones
    ]
    model.AddDimensionWithVehicleTransitAndCapacity(by_drone, 0, longest, True, "length")
    for task in range(num_tasks):
        model.AddDisjunction([manager.NodeToIndex(task)], LEFT_OUT)
    settings = pywrapcp.DefaultRoutingSearchParameters()
    settings.first_solution_strategy = enums.FirstSolutionStrategy.PARALLEL_CHEAPEST_INSERTION
    settings.local_search_metaheuristic = enums.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
    if solutions is not None:
        settings.solution_limit = max(solutions, 1)
    if not deadline.is_never:
        settings.time_limit.FromMilliseconds(max(int(1e3 * deadline.left_s), LEAST_MS))
    return _solve(model, manager, settings, warm_start, num_tasks)


def _matrix(scene: Scene, travel: Travel, kind: int) -> NDArray[np.int64]:
    """Distances for drones of one class between tasks, starts and ends, in this order, in units."""
    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    metres = np.full((num_tasks + 2 * num_drones, num_tasks + 2 * num_drones), np.inf)
    first, last = num_tasks, num_tasks + num_drones
    metres[:num_tasks, :num_tasks] = travel.task_task[kind]
    metres[first:last, :num_tasks] = travel.start_task
    metres[:num_tasks, last:] = travel.task_end.T
    metres[np.arange(first, last), np.arange(last, last + num_drones)] = travel.start_end
    np.fill_diagonal(metres, 0.0)
    return in_units(metres)


def _solve(model: Any, manager: Any, settings: Any, warm_start: RouteTuple, num_tasks: int) -> RouteTuple:
    model.CloseModelWithParameters(settings)
    first = model.ReadAssignmentFromRoutes([list(route) for route in warm_start], True) if warm_start else None
    with _interrupts() as interrupted:
        model.AddSearchMonitor(model.solver().CustomLimit(lambda: bool(interrupted)))
        solution = model.SolveFromAssignmentWithParameters(first, settings) if first else model.SolveWithParameters(settings)
    if interrupted:
        raise KeyboardInterrupt
    if solution is None:
        raise SolverFailed("OR-Tools routing", f"no solution, status {model.status()}")
    routes = []
    for drone in range(model.vehicles()):
        index, route = solution.Value(model.NextVar(model.Start(drone))), []
        while not model.IsEnd(index):
            route.append(manager.IndexToNode(index))
            index = solution.Value(model.NextVar(index))
        routes.append(tuple(route))
    return tuple(routes)


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Interrupts from the keyboard while the solver runs, which keeps Python from acting on them."""
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield seen
        return
    before = signal.signal(signal.SIGINT, lambda number, _: seen.append(number))
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, before)
