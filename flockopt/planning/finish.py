"""A proposal made a plan, and judged."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

from flockopt.bundles import Bound, Bundles
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.certificate import Cost, Plan
from flockopt.certificate.judge import certify
from flockopt.flights import Flight
from flockopt.flights.apart.deconflict import deconflict
from flockopt.flights.decode import decode
from flockopt.flights.smoothing.smooth import smooth
from flockopt.planning.margins import is_enough, margins, roomier
from flockopt.planning.planners import Proposal, Request, Smoother
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["draft_plan", "plan_cost"]


#: Travel below this is none: its gap to a bound of zero is zero, while any other has none.
NO_TRAVEL_M = 1e-6


Progress = Callable[[str, float], None]


def _finish(
    request: Request, planner: str, proposal: Proposal, clock: _Clock, *, bound: str, smoothing: bool, margin_m: float
) -> Plan:
    """A proposal made a plan, and judged."""
    scene, travel, bundles = request.scene, request.travel, proposal.bundles
    draft = replace(draft_plan(scene, planner, bundles), episode_steps=proposal.episode_steps)
    if bundles.status == "infeasible":
        return replace(draft, status="infeasible", reason=bundles.reason)
    with clock.stage("bound", 0.5):
        # what all tasks cost at least says nothing of a plan that leaves some out
        upper = travel.total(bundles.routes)
        proof = None if bundles.unserved else lower_bound(scene, travel, bound=bound, upper=upper)
    for clearance_m, separation_m in margins(margin_m):
        with clock.stage("decode", 0.6):
            room, ways = roomier(scene, travel, bundles, clearance_m, separation_m)
            flights = decode(room, bundles, proposal.samples, travel=ways)
        if smoothing or proposal.smoother is not None:
            with clock.stage("smooth", 0.65):
                flights = _smoothed(room, flights, proposal.smoother, smoothing)
        with clock.stage("deconflict", 0.7):
            flights = deconflict(room, bundles, flights, travel=ways).flights
        draft = replace(draft, flights=flights, cost=plan_cost(travel, bundles, flights, proof))
        with clock.stage("certify", 0.9):
            certificate = certify(scene, draft, travel=travel, bound=proof)
        if is_enough(certificate):
            break
    return replace(draft, status="certified" if certificate.certified else "uncertified", certificate=certificate)


def _smoothed(scene: Scene, flights: dict[str, Flight], smoother: Smoother | None, smoothing: bool) -> dict[str, Flight]:
    """The flights as the proposal's smoother makes them, or as the solver does that begins with those."""
    better = flights if smoother is None else smoother(scene, flights)
    return smooth(scene, flights, starts=better) if smoothing else better


def draft_plan(scene: Scene, planner: str, bundles: Bundles) -> Plan:
    """The plan as far as the allocation makes it."""
    names = [task.id for task in scene.tasks]
    return Plan(
        scene_name=scene.name,
        scene_sha256=scene.sha256,
        planner=planner,
        status="uncertified",
        routes={drone.id: tuple(names[task] for task in route) for drone, route in zip(scene.drones, bundles, strict=True)},
        unserved={names[task]: reason for task, reason in bundles.unserved},
        flights={},
        cost=Cost(length=0.0, travel=0.0, lower_bound=None, gap=None, makespan=0.0),
        certificate=None,
        timing={},
    )


def plan_cost(travel: Travel, bundles: Bundles, flights: dict[str, Flight], proof: Bound | None) -> Cost:
    """What flights along bundles cost, against a proven bound where there is one."""
    total = travel.total(bundles.routes)
    lower, gap = None, None
    if proof is not None:
        lower = proof.value
        gap = (total - lower) / lower if lower > 0.0 else 0.0 if total <= NO_TRAVEL_M else None
    return Cost(
        length=sum(flight.curve.length for flight in flights.values()),
        travel=total,
        lower_bound=lower,
        gap=gap,
        makespan=max((flight.curve.end_time for flight in flights.values()), default=0.0),
    )


class _Clock:
    """Seconds per stage, and word of progress."""

    def __init__(self, progress: Progress | None) -> None:
        self.progress = progress
        self.began = perf_counter()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, fraction: float) -> Iterator[None]:
        """Time a stage that begins when ``fraction`` of the whole is done."""
        if self.progress is not None:
            self.progress(name, fraction)
        began = perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - began

    @property
    def total(self) -> float:
        """Seconds since the beginning."""
        return perf_counter() - self.began

    def timing(self) -> dict[str, float]:
        """The stages' seconds and their total."""
        return {**self.seconds, "total": self.total}
