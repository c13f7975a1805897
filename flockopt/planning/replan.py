"""Replanning from flight: tasks come and go, drones are lost, and the fleet flies on.

The old plan is flown, unchanged and certified, until the swap, a short freeze after the events. From there on a new
plan holds, for a new scene: drones start where the old curves have brought them, with their velocity and
acceleration, so the splice is C2; only open tasks are left, and the new plan has a certificate of its own. Drones
whose route stays the same keep the very curve they fly. Nothing uncertified is swapped in: where no new plan is
certified, the old one goes on as far as the events allow, and what it cannot serve is named.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np

from flockopt.batches.deadline import Deadline, OutOfTime
from flockopt.bundles import Bundles
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.bundles.refine import refine_bundles
from flockopt.certificate import Plan
from flockopt.certificate.placement import flights_into
from flockopt.errors import SceneError, SettingsError
from flockopt.flights import Flight
from flockopt.flights.apart.deconflict import Deconflicted
from flockopt.flights.decode import fly
from flockopt.flights.waypoints import SAME_POINT_M, Waypoints, waypoints_from_paths
from flockopt.planning.finish import Clock, draft, finish
from flockopt.planning.handover import Changes, Situation, check_added, hand_over
from flockopt.planning.settings import PlanSettings
from flockopt.planning.workplace import Workplace
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel, pairs_on
from flockopt.travel.travel import places, straight_travel

__all__ = ["Changes", "Replanned", "replan"]

#: Seconds between an event and the swap: what replanning may take while the old plan is flown on.
FREEZE_S = 0.3

#: How often the swap is put off by another freeze where rounding makes the moment no valid scene.
MOST_SWAPS = 5

#: Iterations of the search, which starts from bundles that were good a moment ago.
ITERATIONS = 600

#: A new allocation must save this share of the travel to be worth changing what drones are about to do.
WORTH_CHANGING = 0.01

#: Up to so many obstacles, and pairs of places times obstacles, all distances are found; beyond, those that matter, and no
#: bound is claimed.
FEW_OBSTACLES, SMALL_WORK = 80, 60_000

#: How many of the places nearest to an open task, by the straight line, the true distance to it is found of.
NUM_NEAR = 12

#: Strategies that may lead a drone another way although its tasks are the same.
ANEW = ("new", "old")

#: Rests tried at the first waypoint of drones that meet others and cannot wait where they are, for they fly; seconds.
RESTS_S = (0.0, 1.0, 2.0, 4.0, 7.0)


@dataclass(frozen=True)
class Replanned:
    """The answer to an event.

    Attributes:
        scene: What is left to do from the swap on: drones as they fly, the tasks that the plan serves.
        plan: The plan for that scene; its t = 0 is the swap. Swap only if it is ``certified``.
        swap_s: When to swap, seconds on the old plan's clock.
        unserved: Reason by id of every open task that is left out.
        strategy: ``"new"`` bundles; the ``"old"`` ones with open tasks inserted, or ``"appended"`` to be served after all
            others from rest; or the old ones ``"kept"`` as they were; ``"none"`` if there was no moment to swap at.
        seconds: How long replanning took.
    """

    scene: Scene
    plan: Plan
    swap_s: float
    unserved: dict[str, str]
    strategy: str
    seconds: float


def replan(
    scene: Scene,
    plan: Plan,
    now_s: float,
    changes: Changes,
    settings: PlanSettings | None = None,
    *,
    freeze_s: float = FREEZE_S,
    airborne: Collection[str] = (),
    **keywords: Any,
) -> Replanned:
    """A certified plan from flight after something has happened.

    Args:
        scene: The scene of the plan being flown.
        plan: The certified plan being flown.
        now_s: Seconds on its clock, >= 0.
        changes: What has happened.
        settings: As for `flockopt.plan`; replanning heeds its ``seed``, ``time_limit_s`` and ``tracking_margin_m``. Bundles are
            searched, begun with those that are flown, whoever planned them.
        freeze_s: Seconds the old plan is flown on before the swap, >= 0; 0 suits a fleet that has not taken off.
        airborne: Ids of drones that hover, as far as the plan does not tell by giving them flights: they may make way even if
            they have no capacity left, while a drone that never had any is grounded.
        **keywords: Fields of `flockopt.planning.settings.PlanSettings` that take the place of those in ``settings``.

    Raises:
        SettingsError: If the plan is not certified or for another scene, a time is out of range, a change names
            what is not there, or a setting is none.
        SceneError: If a new task is not valid in the scene.
    """
    began = perf_counter()
    settings = PlanSettings.of(settings, keywords)
    _check(scene, plan, now_s, changes, freeze_s)
    handed_over = _situation(scene, plan, now_s, changes, freeze_s)
    if handed_over is None:
        return Replanned(scene, replace(plan, status=Status.UNCERTIFIED), now_s, {}, "none", perf_counter() - began)
    situation, swap_s = handed_over
    workplace = Workplace.of(situation.scene)
    situation = replace(situation, scene=workplace.scene, flights=flights_into(workplace.frame, situation.flights))
    hovering = {*airborne, *plan.flights}
    deadline, strategy = Deadline.after(settings.time_limit_s), "none"
    left: Scene = situation.scene
    unserved: dict[str, str] = {}
    result = draft(left, "replan", Bundles(situation.routes))
    try:
        for strategy, bundles, travel in _proposals(situation, settings.seed, changes, deadline):
            finishing = _Finishing(strategy, settings.tracking_margin_m, hovering, deadline)
            left, result, unserved = _finished(situation, travel, bundles, finishing)
            if result.status == Status.CERTIFIED:
                break
        left = workplace.asked_about(left)
        result = workplace.handed_back(result, left, deadline=deadline)
    except OutOfTime as fault:
        result = replace(result, status=Status.UNCERTIFIED, reason=f"{fault}; give it more time")
    return Replanned(left, result, swap_s, situation.unreachable | unserved, strategy, perf_counter() - began)


def _check(scene: Scene, plan: Plan, now_s: float, changes: Changes, freeze_s: float) -> None:
    if plan.scene_sha256 != scene.sha256:
        raise SettingsError(
            "plan", f"is for scene {plan.scene_sha256[:12]}", f"must be for {scene.sha256[:12]}", "plan this scene"
        )
    if plan.status != Status.CERTIFIED:
        raise SettingsError("plan", f"is {plan.status}", "only a certified plan is flown on", "plan the scene first")
    if not 0.0 <= now_s < np.inf:
        raise SettingsError("now_s", f"is {now_s!r}", "must be seconds >= 0 on the plan's clock", "correct it")
    if not 0.0 <= freeze_s < np.inf:
        raise SettingsError("freeze_s", f"is {freeze_s!r}", "must be seconds >= 0", "give replanning some time")
    drones, tasks = {drone.id for drone in scene.drones}, {task.id for task in scene.tasks}
    for field, names, known in (
        ("removed", changes.removed, tasks),
        ("lost", changes.lost, drones),
        ("late", changes.late, drones),
        ("missed", changes.missed, tasks),
    ):
        for name in names:
            if name not in known:
                raise SettingsError(field, f"names {name!r}", "must name what is in the scene", "correct its spelling")
    if drones <= set(changes.lost):
        raise SettingsError("lost", "names every drone", "somebody must be left to fly", "there is nothing to plan")


def _situation(scene: Scene, plan: Plan, now_s: float, changes: Changes, freeze_s: float) -> tuple[Situation, float] | None:
    """The situation at the first moment after the freeze that is a valid scene, and that moment; None if there is none."""
    check_added(scene, changes.added)  # a bad new task is the caller's fault, not the moment's
    for attempt in range(1, MOST_SWAPS + 1):
        swap_s = now_s + attempt * freeze_s
        try:
            return hand_over(scene, plan, swap_s, changes, now_s), swap_s
        except SceneError:
            continue
        except SettingsError:
            if attempt == 1:
                raise
            break  # by now a drone that is late would be in motion
    return None


def _proposals(
    situation: Situation, seed: int, changes: Changes, deadline: Deadline
) -> Iterator[tuple[str, Bundles, Travel | None]]:
    """Bundles to try, the most wanted first, each with the travel they are costed by, None for that of their own legs alone.

    The old ones, untouched, come last; they are all there is where nothing has happened.
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


@dataclass(frozen=True)
class _Finishing:
    """How bundles are made a plan.

    Attributes:
        strategy: How they came about.
        margin_m: Room for tracking errors, metres.
        airborne: Ids of drones that hover.
        deadline: When to give up.
    """

    strategy: str
    margin_m: float
    airborne: Collection[str]
    deadline: Deadline


def _finished(
    situation: Situation, travel: Travel | None, bundles: Bundles, how: _Finishing
) -> tuple[Scene, Plan, dict[str, str]]:
    """The scene of what the bundles serve, the plan for it, certified or not, and what is left out."""
    scene = situation.scene
    unserved = {scene.tasks[task].id: reason for task, reason in bundles.unserved}
    if unserved:
        kept = [j for j, task in enumerate(scene.tasks) if task.id not in unserved]
        place = {j: k for k, j in enumerate(kept)}
        scene = scene.replace(tasks=tuple(scene.tasks[j] for j in kept))
        travel = None if travel is None else compute_travel(scene, deadline=how.deadline)
        bundles = Bundles(tuple(tuple(place[j] for j in route) for route in bundles))
    proof = None if travel is None else lower_bound(scene, travel, bound="fast")
    travel = travel or compute_travel(scene, routes=bundles.routes, deadline=how.deadline)
    source = _FlightsFromSwap(situation, bundles, how.strategy)
    result = finish(
        scene, travel, bundles, source, planner="replan", proof=proof, margin_m=how.margin_m, airborne=how.airborne,
        clock=Clock(deadline=how.deadline),
    )  # fmt: skip
    return scene, result, unserved


@dataclass
class _FlightsFromSwap:
    """Flights of a fleet in motion: where they meet, drones that cannot wait rest on their way, longer each time.

    Attributes:
        situation: The fleet at the swap.
        bundles: Which drone visits what, of the scene that is finished.
        strategy: How the bundles came about.
    """

    situation: Situation
    bundles: Bundles
    strategy: str

    def first(self, scene: Scene, travel: Travel, clock: Clock) -> dict[str, Flight]:
        """See `flockopt.planning.finish.Flights.first`."""
        self._scene, self._travel, self._rests = scene, travel, list(RESTS_S)
        with clock.stage("decode", 0.6):
            return self._fly()

    def again(self, apart: Deconflicted) -> dict[str, Flight] | None:
        """See `flockopt.planning.finish.Flights.again`."""
        return self._fly() if self._rests and _rests_could_help(self.situation, self._flights, apart) else None

    def _fly(self) -> dict[str, Flight]:
        rest_s = self._rests.pop(0)
        self._flights = _flights(self.situation, self._scene, self._travel, self.bundles, rest_s, self.strategy)
        return self._flights


def _rests_could_help(situation: Situation, flights: dict[str, Flight], apart: Deconflicted) -> bool:
    """Whether a drone that starts in motion, on a new flight, is among those that meet."""
    met = {name for conflict in apart.unresolved for name in conflict.drones}
    return any(
        drone.id in met
        and (any(drone.velocity) or any(drone.acceleration))
        and flights.get(drone.id) is not situation.flights.get(drone.id)
        for drone in situation.scene.drones
    )


def _flights(
    situation: Situation, scene: Scene, travel: Travel, bundles: Bundles, rest_s: float, strategy: str
) -> dict[str, Flight]:
    """Flights from the swap: the old curve where the route is the old one, a new one elsewhere.

    Drones on a new route that start in motion rest for ``rest_s`` seconds at their first waypoint, if that is > 0. With
    the strategy "appended" drones fly their old flights to the end before they turn to tasks that were not theirs.
    """
    flights = dict(situation.flights)
    for index, drone in enumerate(scene.drones):
        old = tuple(situation.scene.tasks[task].id for task in situation.routes[index])
        new = tuple(scene.tasks[task].id for task in bundles[index])
        moving = any(drone.velocity) or any(drone.acceleration)
        if old == new and not (drone.id in situation.astray and strategy in ANEW):
            continue
        if strategy == "appended" and drone.id in flights and old == new[: len(old)]:
            flights[drone.id] = _continued(scene, travel, index, bundles[index], flights[drone.id], len(old))
            continue
        waypoints = waypoints_from_paths(scene, travel, index, bundles[index])
        if moving and rest_s > 0.0:
            waypoints = _resting(waypoints, rest_s)
        flights.pop(drone.id, None)
        if waypoints.moves or new or moving:
            flights[drone.id] = fly(scene, drone, waypoints).shifted(situation.ready_s[drone.id])
    return flights


def _continued(scene: Scene, travel: Travel, index: int, route: tuple[int, ...], flight: Flight, num_flown: int) -> Flight:
    """The old flight, flown to rest at its last task, and a new one from there through the tasks after ``num_flown``."""
    standing = replace(scene.drones[index], velocity=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0))
    legs = [travel.path(index, *pair) for pair in pairwise(route[num_flown - 1 :])]
    onward = fly(scene, standing, Waypoints.join(scene, route[num_flown:], legs))
    return flight.then(onward)


def _resting(waypoints: Waypoints, rest_s: float) -> Waypoints:
    """The same way with a longer rest at its first point after the start."""
    if not waypoints.moves:
        return waypoints
    rests = waypoints.rest_s.copy()
    rests[1] = max(rests[1], 0.0) + rest_s
    return replace(waypoints, rest_s=rests)
