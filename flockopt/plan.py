"""From a scene to a certified plan: propose bundles, make flights of them, keep them apart, judge the result.

Planners only propose; one pipeline finishes every proposal and `flockopt.certify` judges it. Other packages add
planners through the entry-point group ``flockopt.planners`` (docs/adding-a-planner.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import entry_points
from time import perf_counter
from typing import TypeAlias

import numpy as np

from flockopt import reading
from flockopt.allocate.bounds import BOUNDS, lower_bound
from flockopt.allocate.refine import refine_bundles
from flockopt.bundles import Bound, Bundles
from flockopt.certify import certify
from flockopt.curve import Flight
from flockopt.errors import SettingsError
from flockopt.geometry import FloatArray
from flockopt.planfile import Cost, Plan
from flockopt.scene import Scene
from flockopt.trajectory.decode import decode
from flockopt.trajectory.deconflict import deconflict
from flockopt.trajectory.smooth import smooth
from flockopt.trajectory.smooth_program import load_casadi
from flockopt.trajectory.tracking_margin import is_enough, margins, roomier
from flockopt.travel import Travel, compute_travel

__all__ = [
    "ANY_ANGLE", "Planner", "Proposal", "Request", "Smoother", "default_planner", "draft_plan", "find_planner", "plan",
    "plan_cost", "planner_names",
]  # fmt: skip

#: Share of what is left of a time limit that the allocation may use; the rest is for flights and the judge.
ALLOCATION_SHARE = 0.7

#: What the allocation has at least, seconds, when a time limit is all but used up.
LEAST_ALLOCATION_S = 1e-3

#: Travel below this is none: its gap to a bound of zero is zero, while any other has none.
NO_TRAVEL_M = 1e-6

ENTRY_POINTS = "flockopt.planners"

#: Paths that every planner's drones can fly along: the shortest ones. A planner that knows others as well names all of
#: them in an attribute ``paths``.
ANY_ANGLE = "any-angle"

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Request:
    """What a planner is asked.

    Attributes:
        scene: The scene.
        travel: Its obstacle-avoiding distances and paths.
        time_limit_s: Seconds the proposal may take, or None for the planner's own measure.
        seed: For everything random.
        paths: What drones are to fly along, one of those the planner's attribute ``paths`` names.
        tracking_margin_m: How much more room flights are to keep where there is some, metres.
    """

    scene: Scene
    travel: Travel
    time_limit_s: float | None
    seed: int
    paths: str = ANY_ANGLE
    tracking_margin_m: float = 0.0


@dataclass(frozen=True)
class Proposal:
    """What a planner answers.

    Attributes:
        bundles: Which drone visits which tasks in which order.
        samples: (N, T, 3) m, control points of the flights, or None to follow the any-angle paths.
        timing: Seconds the planner spent, by stage.
        episode_steps: In how many steps the allocation was made (the paper's measure), or None where all was allocated at once.
        otherwise: Who is asked where no certified plan comes of this proposal; what that took is the stage ``fallback``.
        smoother: Makes better flights of the decoded ones in the scene they are in, by drone id, or leaves them as they are;
            what it took is part of the stage ``smooth``. With ``plan(..., smoothing=True)`` the solver begins with them.
    """

    bundles: Bundles
    samples: FloatArray | None = None
    timing: dict[str, float] = field(default_factory=dict)
    episode_steps: int | None = None
    otherwise: Planner | None = None
    smoother: Smoother | None = None


#: From a scene and flights to better flights, as from `flockopt.trajectory.proposed.fly_proposals`.
Smoother: TypeAlias = "Callable[[Scene, dict[str, Flight]], dict[str, Flight]]"

Planner: TypeAlias = "Callable[[Request], Proposal]"


def classical(request: Request) -> Proposal:
    """Any-angle travel costs and ruin-and-recreate search."""
    bundles = refine_bundles(request.scene, travel=request.travel, time_limit_s=request.time_limit_s, seed=request.seed)
    return Proposal(bundles)


PLANNERS: dict[str, Planner] = {"classical": classical}

#: Who plans where nobody is named: the first of these that is there and ready.
PREFERRED = ("hybrid", "classical")


def planner_names() -> tuple[str, ...]:
    """Planners at hand: flockopt's own and those of installed packages."""
    return tuple(sorted({*PLANNERS, *(entry.name for entry in entry_points(group=ENTRY_POINTS))}))


def default_planner() -> str:
    """The planner that `plan` takes where none is named.

    It is ``hybrid`` where its weights and what computes them are installed, else ``classical``. A planner that needs more
    than its module says in an attribute ``is_ready``, a function, whether that is there.
    """
    known = planner_names()
    return next(name for name in PREFERRED if name in known and getattr(_planner(name), "is_ready", lambda: True)())


def find_planner(name: str, paths: str = ANY_ANGLE) -> Planner:
    """The planner of this name.

    Raises:
        SettingsError: If there is none, or it does not know these paths.
    """
    planner = _planner(name)
    known: tuple[str, ...] = getattr(planner, "paths", (ANY_ANGLE,))
    if paths not in known:
        rule = f"must be one of {', '.join(known)} for planner {name!r}"
        raise SettingsError("paths", f"is {paths!r}", rule, "choose one, or another planner")
    return planner


def _planner(name: str) -> Planner:
    if name in PLANNERS:
        return PLANNERS[name]
    for entry in entry_points(group=ENTRY_POINTS):
        if entry.name == name:
            planner: Planner = entry.load()
            return planner
    raise SettingsError("planner", f"is {name!r}", f"must be one of {', '.join(planner_names())}", "choose one")


def plan(
    scene: Scene,
    *,
    planner: str | None = None,
    time_limit_s: float | None = None,
    seed: int = 0,
    bound: str = "tight",
    smoothing: bool = False,
    tracking_margin_m: float = 0.0,
    paths: str = ANY_ANGLE,
    progress: Progress | None = None,
) -> Plan:
    """Plan a fleet's flight and certify it.

    Args:
        scene: The scene.
        planner: Who proposes: see `planner_names`; None for `default_planner`.
        time_limit_s: Seconds for the whole plan; None lets the planner stop by its own measure, which makes the
            answer the same on every machine.
        seed: For everything random.
        bound: How hard to prove a lower bound: see `flockopt.allocate.bounds.lower_bound`.
        smoothing: Whether to smooth the flights before they are kept apart: the fleet is done earlier, with less jerk,
            for tens of milliseconds a drone (`flockopt.trajectory.smooth`).
        tracking_margin_m: How far drones may stray from the plan, metres: flights keep that much more clearance, and twice
            that much more separation, as far as the scene leaves the room (`flockopt.trajectory.tracking_margin`). The
            certificate is for the scene as it is.
        paths: What drones fly along: ``any-angle``, the shortest paths, or others that the planner knows.
        progress: Called with a stage's name and the fraction of the whole that is done.

    Returns:
        A plan whose status is ``certified`` if every clause of its certificate holds, ``uncertified`` if the
        certificate names clauses that fail, or ``infeasible`` with the reason and without flights.

    Raises:
        SettingsError: On an unknown planner or bound, paths that the planner does not know, a time limit that is not
            positive, or a negative seed or margin.
        MissingExtra: If smoothing is asked for and CasADi is not installed.
    """
    planner = default_planner() if planner is None else planner
    propose = find_planner(planner, paths)
    _check_settings(time_limit_s, seed, bound)
    margin_m = reading.number(SettingsError, "tracking_margin_m", tracking_margin_m, least=0.0)
    if smoothing:
        load_casadi()
    clock = _Clock(progress)
    with clock.stage("travel", 0.0):
        travel = compute_travel(scene)
    with clock.stage("allocate", 0.1):
        left = None if time_limit_s is None else max(ALLOCATION_SHARE * (time_limit_s - clock.total), LEAST_ALLOCATION_S)
        request = Request(scene, travel, left, seed, paths, margin_m)
        proposal = propose(request)
    clock.seconds.update({"generate": 0.0, **proposal.timing})
    finish = partial(_finish, request, planner, bound=bound, smoothing=smoothing, margin_m=margin_m)
    result = finish(proposal, clock)
    if result.status != "certified" and proposal.otherwise is not None:
        with clock.stage("fallback", 0.95):
            other = finish(proposal.otherwise(request), _Clock(None))
        result = other if other.status == "certified" else result
    return replace(result, timing=clock.timing())


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


def _check_settings(time_limit_s: float | None, seed: int, bound: str) -> None:
    if time_limit_s is not None and not (0.0 < time_limit_s < np.inf):
        raise SettingsError("time_limit_s", f"is {time_limit_s!r}", "must be seconds > 0 or None", "give it some time")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise SettingsError("seed", f"is {seed!r}", "must be an integer >= 0", "choose one")
    if bound not in BOUNDS:
        raise SettingsError("bound", f"is {bound!r}", f"must be one of {', '.join(BOUNDS)}", "choose one")


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
