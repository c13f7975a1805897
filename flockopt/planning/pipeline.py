"""From a scene to a certified plan: travel, a planner's proposal, a bound, and the finishing line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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

__all__ = ["plan", "plan_together", "ready_planner"]

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
    planner = ready_planner(settings)
    limit_s = settings.time_limit_s
    if limit_s is not None:
        for entry in entries_of(PLANNING).values():
            entry.compile()
    clock = Clock(progress, Deadline.after(None if limit_s is None else limit_s + GRACE_S))
    case = _Case(Workplace.of(scene), planner, settings, clock)
    result = case.hopeless()
    if result is None:
        try:
            result = case.completed(case.travel())
        except OutOfTime as fault:
            nobody = Bundles(((),) * scene.num_drones)
            result = replace(draft(scene, planner.name, nobody), reason=out_of_time(fault, clock))
    return case.told(result, clock.total)


def plan_together(scenes: Sequence[Scene], settings: PlanSettings) -> list[Plan]:
    """The plans of several scenes; a planner that can propose for many at once is asked once for all of them.

    A time limit holds for one plan: with one, scenes are planned one after another.

    Raises:
        SettingsError, MissingExtra: As `plan`.
    """
    planner = ready_planner(settings)
    if planner.propose_many is None or settings.time_limit_s is not None:
        return [plan(scene, settings) for scene in scenes]
    begun: list[tuple[_Case, Plan | None, Travel | None, float]] = []
    for scene in scenes:
        clock = Clock()
        case = _Case(Workplace.of(scene), planner, settings, clock)
        hopeless = case.hopeless()
        begun.append((case, hopeless, case.travel() if hopeless is None else None, clock.total))
    requests = [case.request(travel) for case, _, travel, _ in begun if travel is not None]
    asked = Clock()
    proposals = iter(planner.propose_many(requests) if requests else ())
    share_s = asked.total / max(len(requests), 1)
    plans = []
    for case, result, travel, seconds in begun:
        finishing = Clock()
        if travel is not None:
            case.clock.seconds["allocate"] = share_s
            seconds += share_s
            result = case.completed(travel, next(proposals))
        assert result is not None
        plans.append(case.told(result, seconds + finishing.total))
    return plans


def ready_planner(settings: PlanSettings) -> Planner:
    """The planner that settings name, once nothing they ask of it is amiss.

    Raises:
        SettingsError: On an unknown planner, or paths or a backend that it does not know.
        MissingExtra: If what it or smoothing needs is not installed.
    """
    planner = find_planner(settings.planner)
    planner.check(settings.paths, settings.backend)
    if settings.smoothing:
        load_casadi()
    return planner


@dataclass(frozen=True)
class _Case:
    """A scene that is being planned.

    Attributes:
        workplace: The scene, and where it is planned.
        planner: Who proposes.
        settings: How to plan.
        clock: Its stages and its deadline.
    """

    workplace: Workplace
    planner: Planner
    settings: PlanSettings
    clock: Clock

    def hopeless(self) -> Plan | None:
        """The infeasible plan of a scene in which a grounded drone is in the way for good; None where none is."""
        scene = self.workplace.scene
        hopeless = grounded_in_the_way(scene)
        if hopeless is None:
            return None
        result = finish(scene, straight_travel(scene), hopeless, GivenFlights(), planner=self.planner.name)
        return self.workplace.handed_back(result, self.workplace.asked)

    def travel(self) -> Travel:
        """Its travel; raises OutOfTime."""
        with self.clock.stage("travel", 0.0):
            return compute_travel(self.workplace.scene, deadline=self.clock.deadline)

    def request(self, travel: Travel) -> Request:
        """What its planner is asked."""
        settings, left_s = self.settings, None
        if not self.clock.deadline.is_never:
            left_s = max(ALLOCATION_SHARE * (self.clock.deadline.left_s - GRACE_S), LEAST_ALLOCATION_S)
        margin_m = settings.tracking_margin_m
        return Request(self.workplace.scene, travel, left_s, settings.seed, settings.paths, margin_m, settings.backend)

    def completed(self, travel: Travel, proposal: Proposal | None = None) -> Plan:
        """The plan that comes of a proposal, which its planner is asked for where none is given; raises OutOfTime."""
        workplace, clock = self.workplace, self.clock
        with clock.within(1.0 if workplace.is_asked else PLANNING_SHARE):
            result = self._planned(travel, proposal)
        if not workplace.is_asked:
            with clock.stage("certify", 0.98):
                result = workplace.handed_back(result, workplace.asked, travel, clock.deadline)
        return result

    def told(self, result: Plan, total_s: float) -> Plan:
        """The plan with what steered it, and its seconds by stage."""
        timing = {**self.clock.seconds, "total": total_s}
        return replace(result, settings=result.settings or self.settings.to_dict(), timing=timing)

    def _planned(self, travel: Travel, proposal: Proposal | None) -> Plan:
        """What a planner proposes made a plan; where that is not certified, what another one does."""
        result, proposal = self._asked(travel, "allocate", proposal)
        if result.status in (Status.CERTIFIED, Status.INFEASIBLE) or proposal.otherwise is None:
            return result
        try:
            with self.clock.stage("fallback", 0.95):
                other = replace(self, planner=proposal.otherwise, clock=Clock(deadline=self.clock.deadline))
                second, _ = other._asked(travel, "fallback")
        except OutOfTime:
            return result
        return replace(second, planner=self.planner.name) if second.status == Status.CERTIFIED else result

    def _asked(self, travel: Travel, stage: str, proposal: Proposal | None = None) -> tuple[Plan, Proposal]:
        """A proposal, the planner's own where none is given, and the plan that comes of it."""
        request = self.request(travel)
        if proposal is None:
            with self.clock.stage(stage, 0.1):
                proposal = self.planner.propose(request)
        return self._finished(request, proposal), proposal

    def _finished(self, request: Request, proposal: Proposal) -> Plan:
        """A proposal made a plan, and judged."""
        settings, clock = self.settings, self.clock
        clock.seconds.update({"generate": 0.0, **proposal.timing})
        result = finish(
            request.scene,
            request.travel,
            proposal.bundles,
            DecodedFlights(proposal.bundles, proposal.samples, proposal.smoother, settings.smoothing),
            planner=self.planner.name,
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
