"""Allocation by PyVRP, a peer to compare with; flockopt itself does not use it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from flockopt import Scene
from flockopt.bundles import Bundles
from flockopt.errors import require
from flockopt.records.status import Status
from flockopt.travel import Travel

__all__ = ["solve_pyvrp"]

#: PyVRP counts in integers; a metre is so many of its units.
UNITS_A_METRE = 10_000


def solve_pyvrp(scene: Scene, travel: Travel, time_limit_s: float, seed: int) -> Bundles:
    """What PyVRP finds in the time; each drone is a vehicle with a start and an end of its own.

    Raises:
        MissingExtra: If pyvrp is not installed.
    """
    pyvrp = require("pyvrp", extra="peers")
    model = pyvrp.Model()
    # Where a place stands does not matter: PyVRP takes distances from the edges alone, and a missing one for no way.
    places = [model.add_location(0, 0) for _ in range(2 * scene.num_drones + scene.num_tasks)]
    depots = [model.add_depot(place) for place in places[: 2 * scene.num_drones]]
    for place, task in zip(places[len(depots) :], scene.tasks, strict=True):
        model.add_client(place, delivery=task.demand)
    profiles = [model.add_profile() for _ in travel.task_task]
    for i, drone in enumerate(scene.drones):
        limit: dict[str, Any] = {} if drone.max_distance is None else {"max_distance": int(drone.max_distance * UNITS_A_METRE)}
        profile, start, end = profiles[travel.drone_class[i]], depots[2 * i], depots[2 * i + 1]
        model.add_vehicle_type(1, drone.capacity, start_depot=start, end_depot=end, profile=profile, **limit)
    for kind, profile in enumerate(profiles):
        for origin, target, length in _legs(travel, kind):
            if not np.isfinite(length):
                continue
            model.add_edge(places[origin], places[target], distance=int(np.rint(length * UNITS_A_METRE)), profile=profile)
    result = model.solve(stop=pyvrp.stop.MaxRuntime(time_limit_s), seed=seed, display=False)
    routes: list[tuple[int, ...]] = [()] * scene.num_drones
    for route in result.best.routes():
        routes[route.vehicle_type()] = tuple(visit.idx for visit in route.schedule() if visit.is_client())
    if not result.best.is_feasible():
        return Bundles(tuple(routes), status=Status.INCOMPLETE, reason="PyVRP found no allocation that serves all tasks")
    return Bundles(tuple(routes))


def _legs(travel: Travel, kind: int) -> Iterator[tuple[int, int, float]]:
    """(origin, target, m) of every leg of a class of drones, by place: starts and ends in turn, then tasks."""
    num_drones, num_tasks = travel.start_task.shape
    first = 2 * num_drones
    for i in np.flatnonzero(travel.drone_class == kind).tolist():
        yield 2 * i, 2 * i + 1, travel.start_end[i]
        for j in range(num_tasks):
            yield 2 * i, first + j, travel.start_task[i, j]
            yield first + j, 2 * i + 1, travel.task_end[i, j]
    yield from ((first + j, first + k, travel.task_task[kind, j, k]) for j in range(num_tasks) for k in range(num_tasks))
