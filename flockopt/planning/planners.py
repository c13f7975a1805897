"""Planners: what they are asked, what they answer, and where they are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import TypeAlias

from flockopt.bundles import Bundles
from flockopt.bundles.refine import refine_bundles
from flockopt.errors import SettingsError
from flockopt.flights import Flight
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = [
    "ANY_ANGLE",
    "PLANNERS",
    "Planner",
    "Proposal",
    "Request",
    "Smoother",
    "default_planner",
    "find_planner",
    "planner_names",
]


ENTRY_POINTS = "flockopt.planners"


#: Paths that every planner's drones can fly along: the shortest ones. A planner that knows others as well names all of
#: them in an attribute ``paths``.
ANY_ANGLE = "any-angle"


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


#: From a scene and flights to better flights, as from `flockopt.flights.smoothing.proposals.fly_proposals`.
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
