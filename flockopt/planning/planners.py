"""Planners: what they are asked, what they answer, and where they are found.

A planner only proposes; `flockopt.planning.finish` finishes every proposal alike and the judge certifies it. Other packages
add planners through the entry-point group ``flockopt.planners`` (docs/adding-a-planner.md); anyone may hand one to
`flockopt.plan` as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import TypeAlias

from flockopt.batches.deadline import Deadline, OutOfTime, heard
from flockopt.bundles import Bound, Bundles
from flockopt.bundles.refine import refine_bundles
from flockopt.errors import PlanError, SettingsError, SolverFailed
from flockopt.flights import Flight
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = [
    "ANY_ANGLE", "PLANNERS", "Planner", "Proposal", "Request", "Smoother", "default_planner", "find_planner", "planner_names",
]  # fmt: skip

ENTRY_POINTS = "flockopt.planners"

#: Shares of a time limit for solving, and of what is left of it then for finding a proof again, before the judge does.
SOLVING_SHARE, RECHECK_SHARE = 0.8, 0.4

#: Paths that every planner's drones can fly along: the shortest ones.
ANY_ANGLE = "any-angle"


@dataclass(frozen=True)
class Request:
    """What a planner is asked.

    Attributes:
        scene: The scene.
        travel: Its obstacle-avoiding distances and paths.
        time_limit_s: Seconds the proposal may take, or None for the planner's own measure.
        seed: For everything random.
        paths: What drones are to fly along, one of the planner's `Planner.paths`.
        tracking_margin_m: How much more room flights are to keep where there is some, metres.
        backend: What computes the planner's networks, or None for the best that is installed.
    """

    scene: Scene
    travel: Travel
    time_limit_s: float | None
    seed: int
    paths: str = ANY_ANGLE
    tracking_margin_m: float = 0.0
    backend: str | None = None


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
        bound: A lower bound that the planner has proven, with its proof; None to have one proven as the settings say.
        made_with: What else steered the proposal, by name, for the plan file: a backend, a digest of weights.
    """

    bundles: Bundles
    samples: FloatArray | None = None
    timing: Mapping[str, float] = field(default_factory=dict)
    episode_steps: int | None = None
    otherwise: Planner | None = None
    smoother: Smoother | None = None
    bound: Bound | None = None
    made_with: Mapping[str, str] = field(default_factory=dict)


#: From a scene and flights to better flights, as from `flockopt.flights.smoothing.proposals.fly_proposals`.
Smoother: TypeAlias = "Callable[[Scene, dict[str, Flight]], dict[str, Flight]]"


def _always() -> bool:
    return True


@dataclass(frozen=True)
class Planner:
    """Somebody who proposes.

    Attributes:
        propose: From a request to a proposal.
        name: What plan files call it; the function's own name where it is left empty.
        paths: What its drones can fly along.
        is_ready: Whether all that it needs is there (weights, libraries), beyond what its module imports.
        takes_backend: Whether it heeds `Request.backend`: it has networks.
        rank: Where no planner is named, the ready one of the highest rank plans; 0 is never chosen unasked.
        propose_many: From several requests, alike but for scene, travel and seed, to their proposals, in their order: for
            networks that answer many scenes at once (`flockopt.plan_many`). None to have them proposed for one by one.
    """

    propose: Callable[[Request], Proposal]
    name: str = ""
    paths: tuple[str, ...] = (ANY_ANGLE,)
    is_ready: Callable[[], bool] = _always
    takes_backend: bool = False
    rank: int = 0
    propose_many: Callable[[Sequence[Request]], Sequence[Proposal]] | None = None

    def __post_init__(self) -> None:
        propose: object = self.propose
        if not callable(propose):
            seen = f"is {checks.shown(self.propose)}"
            raise SettingsError("propose", seen, "must be a function from a request to a proposal", "give one")
        name = self.name or getattr(self.propose, "__name__", "")
        object.__setattr__(self, "name", checks.text(SettingsError, "name", name))
        object.__setattr__(self, "paths", tuple(self.paths))

    def check(self, paths: str = ANY_ANGLE, backend: str | None = None) -> None:
        """Refuse paths that its drones cannot fly along, and a backend where it has no networks.

        Raises:
            SettingsError: Naming the setting, and what could be chosen.
        """
        if backend is not None and not self.takes_backend:
            rule = f"planner {self.name!r} has no networks that a backend could compute"
            raise SettingsError("backend", f"is {backend!r}", rule, "leave it out, or choose another planner")
        if paths not in self.paths:
            rule = f"must be one of {', '.join(self.paths)} for planner {self.name!r}"
            raise SettingsError("paths", f"is {paths!r}", rule, "choose one, or another planner")


def _search(request: Request) -> Proposal:
    """Any-angle travel costs and ruin-and-recreate search."""
    return Proposal(_bundles(request, "search"))


def _route(request: Request) -> Proposal:
    """Any-angle travel costs and OR-Tools' routing solver, for as long as the time limit allows."""
    return Proposal(_bundles(request, "cvrp"))


def _prove(request: Request) -> Proposal:
    """The allocation of least travel, with a proof that can be checked again where there was time for one."""
    from flockopt.bundles.exact.exact import solve_exact
    from flockopt.certificate.proof import recompute_bound

    deadline = Deadline.after(request.time_limit_s)
    solving_s = None if request.time_limit_s is None else SOLVING_SHARE * request.time_limit_s
    result = solve_exact(request.scene, request.travel, time_limit_s=solving_s, seed=request.seed)
    if result.status in (Status.INCOMPLETE, Status.INFEASIBLE):
        return Proposal(result.bundles)
    bound = result.bound
    if result.status == Status.OPTIMAL:
        claim = Bound("optimum", result.proven, bound.dual)
        try:  # the judge will do the same, and may take as long
            again = partial(recompute_bound, request.scene, request.travel, claim)
            proven = heard(again, deadline=deadline.within(RECHECK_SHARE), doing="finding an optimum again")
        except (PlanError, SolverFailed, OutOfTime):  # too much to find again: the bound of the prices alone is claimed then
            proven = bound.value
        bound = claim if proven == claim.value else bound
    return Proposal(result.bundles, bound=bound)


def _bundles(request: Request, method: str) -> Bundles:
    return refine_bundles(
        request.scene, travel=request.travel, method=method, time_limit_s=request.time_limit_s, seed=request.seed
    )


#: flockopt's own planners, by name.
PLANNERS: Mapping[str, Planner] = MappingProxyType(
    {
        planner.name: planner
        for planner in (
            Planner(_search, "classical", rank=10),
            Planner(_prove, "exact"),
            Planner(_route, "ortools"),
        )
    }
)


def planner_names() -> tuple[str, ...]:
    """Planners at hand: flockopt's own and those of installed packages."""
    return tuple(sorted({*PLANNERS, *(entry.name for entry in entry_points(group=ENTRY_POINTS))}))


def default_planner() -> Planner:
    """The planner that `flockopt.plan` takes where none is named: the ready one of the highest rank.

    What an installed package registers and cannot load is passed over: it was not asked for.
    """
    known = list(PLANNERS.values())
    for entry in entry_points(group=ENTRY_POINTS):
        if entry.name not in PLANNERS:
            try:
                known.append(_load(entry))
            except (ImportError, AttributeError, SettingsError):
                continue
    return max((planner for planner in known if planner.rank > 0 and planner.is_ready()), key=lambda planner: planner.rank)


def find_planner(planner: Planner | str | None) -> Planner:
    """The planner of this name, the default one for None; a planner is itself.

    Raises:
        SettingsError: If there is none, or what a package registers under the name is no planner.
    """
    if planner is None:
        return default_planner()
    if isinstance(planner, Planner):
        return planner
    if isinstance(planner, str) and planner in PLANNERS:
        return PLANNERS[planner]
    for entry in entry_points(group=ENTRY_POINTS):
        if entry.name == planner:
            return _load(entry)
    rule = f"must be one of {', '.join(planner_names())}, or a Planner"
    raise SettingsError("planner", f"is {checks.shown(planner)}", rule, "choose one")


def _load(entry: EntryPoint) -> Planner:
    planner = entry.load()
    if not isinstance(planner, Planner):
        seen = f"names {checks.shown(planner)} ({entry.value})"
        raise SettingsError(f"planner {entry.name!r}", seen, "must be a flockopt.planning.planners.Planner", "wrap it in one")
    return planner
