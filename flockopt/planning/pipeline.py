"""From a scene to a certified plan: travel, a planner's proposal, a bound, and the finishing line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from flockopt.batches.deadline import Deadline, OutOfTime
from flockopt.bundles import Bound, Bundles
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.certificate import Plan
from flockopt.flights.smoothing.casadi_program import load_casadi
from flockopt.planning.entries import PLANNING, entries_of
from flockopt.planning.feasibility import grounded_in_the_way
from flockopt.planning.finish import Clock, DecodedFlights, GivenFlights, Reporter, draft, finish, out_of_time
from flockopt.planning.planners import Planner, Proposal, Request, find_planner
from flockopt.planning.settings import PlanSettings
from flockopt.planning.workplace import Workplace
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel
from flockopt.travel.travel import straight_travel

__all__ = ["plan"]

#: Share of what is left of a time limit that the allocation may use; the rest is for flights and the judge.
ALLOCATION_SHARE = 0.7

#: Share of what is left of a time limit that a bound may take; flights are still to come.
BOUND_SHARE = 0.3

#: What is all but done may end so much later than a time limit, seconds: so small scenes are planned under any limit.
GRACE_S = 0.05

#: The same of planning where a plan is handed back into another frame, and judged there once more.
PLANNING_SHARE = 0.85

#: What the allocation has at least, seconds, when a time limit is all but used up.
LEAST_ALLOCATION_S = 1e-3


def plan(scene: Scene, settings: PlanSettings | None = None, *, progress: Reporter | None = None, **keywords: Any) -> Plan:
    """Plan a fleet's flight and certify it.

    Args:
        scene: The scene.
        settings: How to plan; the defaults of `flockopt.planning.settings.PlanSettings` where left out.
        progress: Called with a stage's name and the fraction of the whole that is done.
        **keywords: Fields of `PlanSettings`, the easy way in, which take the place of those in ``settings``: ``planner``,
            ``time_limit_s``, ``seed``, ``bound``, ``smoothing``, ``tracking_margin_m``, ``paths``, ``backend``.

    Returns:
        A plan whose status is ``certified`` if every clause of its certificate holds, ``uncertified`` if the
        certificate names clauses that fail, or ``infeasible`` with the reason and without flights. Where the time limit passes
        before there is a plan to judge, it is ``uncertified``, and its reason says what was not finished. It records what
        steered it (`Plan.settings`).

    Raises:
        SettingsError: On a setting that is none or out of range, an unknown planner, or paths or a backend that the planner
            does not know.
        MissingExtra: If what the planner or smoothing needs is not installed.
    """
    settings = PlanSettings.of(settings, keywords)
    planner = find_planner(settings.planner)
    planner.check(settings.paths, settings.backend)
    if settings.smoothing:
        load_casadi()
    limit_s = settings.time_limit_s
    if limit_s is not None:
        for entry in entries_of(PLANNING).values():
            entry.compile()
    clock = Clock(progress, Deadline.after(None if limit_s is None else limit_s + GRACE_S))
    workplace = Workplace.of(scene)
    hopeless = grounded_in_the_way(workplace.scene)
    if hopeless is not None:
        result = finish(workplace.scene, straight_travel(workplace.scene), hopeless, GivenFlights(), planner=planner.name)
        return replace(workplace.handed_back(result, scene), settings=settings.to_dict(), timing=clock.timing())
    try:
        with clock.stage("travel", 0.0):
            travel = compute_travel(workplace.scene, deadline=clock.deadline)
        with clock.within(1.0 if workplace.is_asked else PLANNING_SHARE):
            result = _planned(workplace.scene, travel, planner, settings, clock)
        if not workplace.is_asked:
            with clock.stage("certify", 0.98):
                result = workplace.handed_back(result, scene, travel, clock.deadline)
    except OutOfTime as fault:
        nobody = Bundles(((),) * scene.num_drones)
        result = replace(draft(scene, planner.name, nobody), reason=out_of_time(fault, clock))
    return replace(result, settings=result.settings or settings.to_dict(), timing=clock.timing())


def _planned(scene: Scene, travel: Travel, planner: Planner, settings: PlanSettings, clock: Clock) -> Plan:
    """What a planner proposes made a plan; where that is not certified, what another one does."""
    result, proposal = _asked(scene, travel, planner, settings, clock, "allocate")
    if result.status in (Status.CERTIFIED, Status.INFEASIBLE) or proposal.otherwise is None:
        return result
    try:
        with clock.stage("fallback", 0.95):
            other, _ = _asked(scene, travel, proposal.otherwise, settings, Clock(deadline=clock.deadline), "fallback")
    except OutOfTime:
        return result
    return replace(other, planner=planner.name) if other.status == Status.CERTIFIED else result


def _asked(
    scene: Scene, travel: Travel, planner: Planner, settings: PlanSettings, clock: Clock, stage: str
) -> tuple[Plan, Proposal]:
    """A planner's proposal, and the plan that comes of it."""
    with clock.stage(stage, 0.1):
        margin_m, left_s = settings.tracking_margin_m, None
        if not clock.deadline.is_never:
            left_s = max(ALLOCATION_SHARE * (clock.deadline.left_s - GRACE_S), LEAST_ALLOCATION_S)
        request = Request(scene, travel, left_s, settings.seed, settings.paths, margin_m, settings.backend)
        proposal = planner.propose(request)
    clock.seconds.update({"generate": 0.0, **proposal.timing})
    return _finished(request, planner.name, proposal, settings, clock), proposal


def _finished(request: Request, planner: str, proposal: Proposal, settings: PlanSettings, clock: Clock) -> Plan:
    """A proposal made a plan, and judged."""
    result = finish(
        request.scene,
        request.travel,
        proposal.bundles,
        DecodedFlights(proposal.bundles, proposal.samples, proposal.smoother, settings.smoothing),
        planner=planner,
        proof=_proof(request, proposal, settings.bound, clock),
        margin_m=settings.tracking_margin_m,
        clock=clock,
    )
    made_with = settings.to_dict() | dict(proposal.made_with)
    return replace(result, episode_steps=proposal.episode_steps, settings=made_with)


def _proof(request: Request, proposal: Proposal, bound: str, clock: Clock) -> Bound | None:
    """A lower bound; None where tasks are left out, since what all tasks cost at least says nothing of such a plan."""
    bundles = proposal.bundles
    if bundles.unserved or bundles.status == Status.INFEASIBLE:
        return None
    with clock.stage("bound", 0.5):
        if proposal.bound is not None:
            return proposal.bound
        upper, deadline = request.travel.total(bundles.routes), clock.deadline.within(BOUND_SHARE)
        return lower_bound(request.scene, request.travel, bound=bound, upper=upper, deadline=deadline)
