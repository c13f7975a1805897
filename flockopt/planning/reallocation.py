"""What a fleet in flight may do next: bundles to try, begun with those that it flies."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flockopt.batches.deadline import Deadline
from flockopt.bundles import Bundles
from flockopt.bundles.refine import refine_bundles
from flockopt.flights.waypoints import SAME_POINT_M
from flockopt.planning.handover import Changes, Situation
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel, pairs_on
from flockopt.travel.travel import places, straight_travel

__all__ = ["proposals"]

#: Iterations of the search, which starts from bundles that were good a moment ago.
ITERATIONS = 600

#: A new allocation must save this share of the travel to be worth changing what drones are about to do.
WORTH_CHANGING = 0.01

#: Up to so many obstacles, and pairs of places times obstacles, all distances are found; beyond, those that matter, and no
#: bound is claimed.
FEW_OBSTACLES, SMALL_WORK = 80, 60_000

#: How many of the places nearest to an open task, by the straight line, the true distance to it is found of.
NUM_NEAR = 12


def proposals(
    situation: Situation, seed: int, changes: Changes, deadline: Deadline
) -> Iterator[tuple[str, Bundles, Travel | None]]:
    """Bundles to try, the most wanted first, each with the travel they are costed by, None for that of their own legs alone.

    The old ones, untouched, come last; they are all there is where nothing has happened.

    Args:
        situation: The fleet at the swap.
        seed: Of the search.
        changes: What has happened.
        deadline: When to give up.

    Returns:
        Strategies as in `flockopt.planning.replan.Replanned.strategy`, bundles, and travel.

    Raises:
        OutOfTime: If the deadline passes.
    """
    scene, served = situation.scene, {task for route in situation.routes for task in route}
    if changes == Changes() and len(served) == scene.num_tasks:
        yield "kept", Bundles(situation.routes), None
    num_obstacles, num_places = len(scene.obstacles), scene.num_tasks + scene.num_drones
    is_small = num_obstacles <= FEW_OBSTACLES and scene.num_tasks * num_places * num_obstacles <= SMALL_WORK
    travel = compute_travel(scene, deadline=deadline) if is_small else _rough_travel(situation, deadline)
    known = travel if is_small else None
    old = _inserted(situation, travel, seed)
    new = refine_bundles(scene, travel=travel, iterations=ITERATIONS, seed=seed, warm_start=old)

    def metres(bundles: Bundles) -> float:
        return (known or compute_travel(scene, routes=bundles.routes, deadline=deadline)).total(bundles.routes)

    old_m, drops = metres(old), _left_out(new) & situation.earlier - _left_out(old)
    if not drops and (len(new.unserved) < len(old.unserved) or travel.total(new.routes) < travel.total(old.routes)):
        new_m = metres(new)
        if np.isfinite(new_m) and (new_m < (1.0 - WORTH_CHANGING) * old_m or len(new.unserved) < len(old.unserved)):
            yield "new", new, known
    if np.isfinite(old_m):
        yield "old", old, known
    appended = _appended(situation, travel)
    if np.isfinite(metres(appended)):
        yield "appended", appended, known
    reason = "no certified plan that serves it was found from flight; ask again later"
    left = tuple((task, reason) for task in range(scene.num_tasks) if task not in served)
    yield "kept", Bundles(situation.routes, left), known


def _rough_travel(situation: Situation, deadline: Deadline) -> Travel:
    """Distances in which those along the old routes, and of open tasks to what is near, are true; all others are straight."""
    scene = situation.scene
    true = pairs_on(scene, situation.routes)
    unserved = sorted(set(range(scene.num_tasks)) - {task for route in situation.routes for task in route})
    where = places(scene)
    for task in unserved:
        away = np.nan_to_num(np.linalg.norm(where - where[task], axis=1), nan=np.inf)
        near = np.argsort(away, kind="stable")[: NUM_NEAR + 1]
        true[task, near] = true[near, task] = True
    found, straight = compute_travel(scene, wanted=true, deadline=deadline), straight_travel(scene)
    tasks, starts = slice(scene.num_tasks), slice(scene.num_tasks, scene.num_tasks + scene.num_drones)
    ends = slice(starts.stop, None)
    return Travel(
        np.where(true[starts, tasks], found.start_task, straight.start_task),
        np.where(true[tasks, tasks], found.task_task, straight.task_task),
        np.where(true[tasks, ends].T, found.task_end, straight.task_end),
        np.where(true[starts, ends].diagonal(), found.start_end, straight.start_end),
        found.drone_class,
    )


def _inserted(situation: Situation, travel: Travel, seed: int) -> Bundles:
    """The old bundles with open tasks put in where that is shortest: those that were there before ahead of new ones."""
    scene, routes = situation.scene, situation.routes
    bundles = refine_bundles(scene, travel=travel, iterations=0, seed=seed, warm_start=routes)
    if not _left_out(bundles) & situation.earlier or not set(range(scene.num_tasks)) - situation.earlier:
        return bundles
    earlier = sorted(situation.earlier)
    place = {task: k for k, task in enumerate(earlier)}
    before = scene.replace(tasks=tuple(scene.tasks[task] for task in earlier))
    begun = [[place[task] for task in route] for route in routes]
    first = refine_bundles(before, travel=travel.of_tasks(earlier), iterations=0, seed=seed, warm_start=begun)
    kept = [[earlier[task] for task in route] for route in first]
    return refine_bundles(scene, travel=travel, iterations=0, seed=seed, warm_start=kept)


def _left_out(bundles: Bundles) -> set[int]:
    return {task for task, _ in bundles.unserved}


def _appended(situation: Situation, travel: Travel) -> Bundles:
    """The old bundles, each open task put behind the drone's last one where that is shortest."""
    scene, routes = situation.scene, [list(route) for route in situation.routes]
    may_append = [_stops_at_last_task(situation, index) for index in range(scene.num_drones)]
    left = []
    for task in sorted(set(range(scene.num_tasks)) - {task for route in routes for task in route}):
        longer = [
            travel.route_length(index, [*route, task]) - travel.route_length(index, route)
            if may_append[index] and scene.drones[index].capacity >= scene.demands[[*route, task]].sum()
            else np.inf
            for index, route in enumerate(routes)
        ]
        if np.isfinite(min(longer)):
            routes[int(np.argmin(longer))].append(task)
        else:
            left.append((task, "no drone has capacity left to serve it after its other tasks; add a drone"))
    return Bundles(tuple(tuple(route) for route in routes), tuple(left))


def _stops_at_last_task(situation: Situation, index: int) -> bool:
    """Whether more tasks can follow the drone's old flight: it rests at its last task or never took off."""
    drone, route = situation.scene.drones[index], situation.routes[index]
    flight = situation.flights.get(drone.id)
    if drone.end is not None or drone.max_distance is not None:
        return False
    if flight is None or not route:
        return flight is None and not route
    away = flight.curve(flight.curve.end_time) - situation.scene.task_positions[route[-1]]
    return bool(np.linalg.norm(away) < SAME_POINT_M)
