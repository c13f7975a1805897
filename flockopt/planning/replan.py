"""Replanning from flight: tasks come and go, drones are lost, and the fleet flies on.

The old plan is flown, unchanged and certified, until the swap, a short freeze after the events. From there on a new
plan holds, for a new scene: drones start where the old curves have brought them, with their velocity and
acceleration, so the splice is C2; only open tasks are left, and the new plan has a certificate of its own. Drones
whose route stays the same keep the very curve they fly. Nothing uncertified is swapped in: where no new plan is
certified, the old one goes on as far as the events allow, and what it cannot serve is named.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np

from flockopt.batches.deadline import Deadline, OutOfTime
from flockopt.bundles import Bundles
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.certificate import Plan
from flockopt.certificate.placement import flights_into
from flockopt.errors import SceneError, SettingsError
from flockopt.flights import Flight
from flockopt.flights.apart.deconflict import Deconflicted
from flockopt.flights.decode import fly
from flockopt.flights.waypoints import Waypoints, waypoints_from_paths
from flockopt.planning.finish import Clock, draft, finish
from flockopt.planning.handover import Changes, Situation, check_added, hand_over
from flockopt.planning.reallocation import proposals
from flockopt.planning.settings import PlanSettings
from flockopt.planning.workplace import Workplace
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel

__all__ = ["Changes", "Replanned", "replan"]

#: Seconds between an event and the swap: what replanning may take while the old plan is flown on.
FREEZE_S = 0.3

#: How often the swap is put off by another freeze where rounding makes the moment no valid scene.
MOST_SWAPS = 5

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
        for strategy, bundles, travel in proposals(situation, settings.seed, changes, deadline):
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
