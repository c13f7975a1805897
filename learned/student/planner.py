"""The planners that the student registers: ``learned``, ``learned-paper`` and ``hybrid``.

``learned`` is the network's answer: its head's probabilities refined to bundles, its denoiser's samples as control points;
it searches no paths, and where a leg comes out blocked the pipeline's decoder mends it. ``hybrid`` searches bundles from
the head's probabilities and as the classical planner does, keeps the better ones, flies what is drawn where that is sooner
than the shortest path, has the timed flights' network smooth the fleet, and hands over to the classical planner where a
clause of the certificate fails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from flockopt.bundles import Bundles
from flockopt.bundles.refine import refine_bundles
from flockopt.errors import SettingsError, require
from flockopt.flights.decode import decode
from flockopt.flights.waypoints import waypoints_from_paths
from flockopt.planning.planners import PLANNERS, Proposal, Request
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from learned.networks.planners import planner_of_many
from learned.networks.shipped import load_once, shipped_path
from learned.smoother.smoother import WEIGHTS as TIMED_WEIGHTS
from learned.smoother.smoother import smooth_flights

if TYPE_CHECKING:
    from learned.student.backends.choice import Loaded
    from learned.student.inference import DrawnFleet, Network
    from learned.student.network.model import Student
    from learned.student.network.scene_encoder import AgentTokens
    from learned.student.scenes.examples import Example

__all__ = [
    "HYBRID", "LEARNED", "LEARNED_PAPER", "PAPER_WEIGHTS", "WEIGHTS", "drawn_plan", "drawn_plans", "loaded_student",
    "searched_plan", "searched_plans", "shipped_student",
]  # fmt: skip

#: The weights that come with the package, of the default configuration and of the paper's.
WEIGHTS, PAPER_WEIGHTS = shipped_path("student-small"), shipped_path("student-paper")

#: Iterations of the search that refines the head's probabilities: enough to mend what capacities break.
REFINING_ITERATIONS = 100

#: DDIM steps of the first try and of the others, which are made only where that is not clear; and how many tries there are.
STEPS, TRIES = (1, 2), 4

#: Shares of a time limit for the search that the head guides, and for the one that begins from nothing; the networks have
#: the rest.
GUIDED_SHARE, SEARCH_SHARE = 0.1, 0.8

#: Backends whose networks have answered in this process: the first time takes longer.
_ANSWERED: set[str | None] = set()

#: Seconds that loading torch and the networks may take, and their answers, at first and for each drone and task.
LOADING_S, ANSWERING_S, ANSWERING_S_A_PLACE = 6.0, 0.1, 2e-3

#: A drawn flight must end sooner than the one along the shortest path by this, seconds.
LEAST_GAIN_S = 1e-3


def shipped_student(path: Path = WEIGHTS) -> Student:
    """The student whose weights come with the package, loaded once.

    Raises:
        SettingsError: If the weights are missing or damaged.
        MissingExtra: If torch or safetensors is not installed.
    """
    require("torch", extra="learned")
    from learned.student.checkpoint import load_student

    return load_once(load_student, path)


def loaded_student(backend: str | None = None, path: Path = WEIGHTS) -> Loaded:
    """The shipped student as a backend computes it, with what a plan says of it: see `learned.student.backends.choice`.

    Raises:
        SettingsError: If there is no such backend, it cannot compute this student, or the weights are missing or damaged.
        MissingExtra: If torch, safetensors or what the backend needs is not installed.
    """
    student = shipped_student(path)
    from learned.student.backends.choice import loaded

    return loaded(student, path, backend)


def learned(requests: Sequence[Request], weights: Path = WEIGHTS) -> list[Proposal]:
    """The network's bundles and flights; of the paper's configuration, which draws whole fleets, only torch computes them."""
    student = loaded_student(requests[0].backend, weights)
    return [
        Proposal(bundles, None if drawing is None else drawing.samples, timing, made_with=_told(student))
        for bundles, drawing, timing in drawn_plans(student.network, requests)
    ]


def _told(student: Loaded) -> dict[str, str]:
    """What a plan says of the student behind it."""
    return {"backend": student.backend, "weights": student.digest}


#: Bundles, the drawn fleet if it can be drawn, and seconds by stage.
DrawnPlan: TypeAlias = "tuple[Bundles, DrawnFleet | None, dict[str, float]]"


def drawn_plan(student: Network, request: Request) -> DrawnPlan:
    """Bundles from the head, what the denoiser draws for them if it can, and seconds by stage."""
    (drawn,) = drawn_plans(student, [request])
    return drawn


def drawn_plans(student: Network, requests: Sequence[Request]) -> list[DrawnPlan]:
    """`drawn_plan` of several scenes: one pass of the network decides for all of them, and one draws all fleets.

    The seconds of each stage are shared evenly.
    """
    return _plans(student, requests, _mended)


def _mended(request: Request, preferences: FloatArray | None) -> Bundles:
    """Bundles along the preferences, mended where capacities break them."""
    return refine_bundles(
        request.scene, preferences, travel=request.travel, iterations=REFINING_ITERATIONS,
        time_limit_s=request.time_limit_s, seed=request.seed,
    )  # fmt: skip


def _plans(
    student: Network, requests: Sequence[Request], search: Callable[[Request, FloatArray | None], Bundles]
) -> list[DrawnPlan]:
    """What is searched for on each scene's probabilities, and what is drawn for it."""
    if not requests:
        return []
    began = perf_counter()
    with _threads(requests):
        probabilities, tokens = _decisions(student, [request.scene for request in requests])
    headed = perf_counter()
    found = [search(request, preferences) for request, preferences in zip(requests, probabilities, strict=True)]
    searched = perf_counter()
    with _threads(requests):
        drawings = _drawings(student, requests, found, tokens)
    seconds = {"head": headed - began, "refine": searched - headed, "generate": perf_counter() - searched}
    timing = {stage: total / len(requests) for stage, total in seconds.items()}
    return [(bundles, drawing, dict(timing)) for bundles, drawing in zip(found, drawings, strict=True)]


def hybrid(requests: Sequence[Request]) -> list[Proposal]:
    """The better of two searches, one of them guided by the network, and the networks' flights; else the classical plan.

    Where the time limit is too short for the networks, the classical proposal, and the plan says so.
    """
    classical, backend = PLANNERS["classical"], requests[0].backend
    limit_s = requests[0].time_limit_s
    if limit_s is not None and limit_s < max(_networks_need_s(request.scene, backend) for request in requests):
        without = {"networks": "none: the time limit is too short for them"}
        return [replace(classical.propose(request), made_with=without) for request in requests]
    student = loaded_student(backend)
    proposals = []
    for request, (bundles, drawing, timing) in zip(requests, searched_plans(student.network, requests), strict=True):
        samples = None if drawing is None else _sooner(request, bundles, drawing.samples)
        proposals.append(Proposal(bundles, samples, timing, otherwise=classical, smoother=smooth_flights))
    _ANSWERED.add(backend)
    from learned.networks.weight_files import file_digest

    told = _told(student) | {"smoother_weights": load_once(file_digest, TIMED_WEIGHTS)}
    return [replace(proposal, made_with=told) for proposal in proposals]


def _networks_need_s(scene: Scene, backend: str | None) -> float:
    """Seconds in which the networks are loaded, if they are not yet, and have answered."""
    loading_s = 0.0 if backend in _ANSWERED else LOADING_S
    return loading_s + ANSWERING_S + ANSWERING_S_A_PLACE * (scene.num_drones + scene.num_tasks)


def _is_ready() -> bool:
    """Whether the weights are there, and what computes them."""
    return all(path.exists() for path in (WEIGHTS, TIMED_WEIGHTS)) and all(map(find_spec, ("torch", "safetensors")))


LEARNED = planner_of_many(learned, "learned", is_ready=_is_ready, takes_backend=True)
LEARNED_PAPER = planner_of_many(
    partial(learned, weights=PAPER_WEIGHTS), "learned-paper", is_ready=_is_ready, takes_backend=True
)

#: It plans where nobody is named and it is ready: its fleets are done sooner, and it is never farther in than ``classical``.
HYBRID = planner_of_many(hybrid, "hybrid", is_ready=_is_ready, takes_backend=True, rank=20)


def searched_plan(student: Network, request: Request) -> DrawnPlan:
    """The better bundles of two searches, what the denoiser draws for them if it can, and seconds by stage."""
    (searched,) = searched_plans(student, [request])
    return searched


def searched_plans(student: Network, requests: Sequence[Request]) -> list[DrawnPlan]:
    """`searched_plan` of several scenes, in as many passes of the network as one takes, as `drawn_plans`."""
    return _plans(student, requests, _best_of_two)


def _best_of_two(request: Request, preferences: FloatArray | None) -> Bundles:
    """The better bundles of a search of its own and, where there are preferences, of one that they guide."""
    plain = _searched(request, None, SEARCH_SHARE)
    return plain if preferences is None else _better(request, plain, _searched(request, preferences, GUIDED_SHARE))


def _better(request: Request, plain: Bundles, guided: Bundles) -> Bundles:
    """The guided bundles where they travel less and the fleet is done no later along its paths; else the plain ones."""
    if guided.unserved or plain.unserved:
        return plain if len(plain.unserved) <= len(guided.unserved) else guided
    scene, travel = request.scene, request.travel
    if travel.total(guided.routes) >= travel.total(plain.routes):
        return plain
    done_s = [
        max((flight.curve.end_time for flight in decode(scene, bundles, travel=travel).values()), default=0.0)
        for bundles in (plain, guided)
    ]
    return guided if done_s[1] <= done_s[0] else plain


def _searched(request: Request, probabilities: FloatArray | None, share: float) -> Bundles:
    """Bundles of one search, in its share of the time limit if there is one."""
    share_s = None if request.time_limit_s is None else share * request.time_limit_s
    return refine_bundles(request.scene, probabilities, travel=request.travel, time_limit_s=share_s, seed=request.seed)


def _sooner(request: Request, bundles: Bundles, samples: FloatArray) -> FloatArray | None:
    """The samples of the drones whose drawn flights end before those along shortest paths, and those paths for the others.

    None where no drawn flight does: the pipeline then flies the paths.
    """
    scene, travel = request.scene, request.travel
    drawn, along_paths = decode(scene, bundles, samples, travel=travel), decode(scene, bundles, travel=travel)
    is_sooner = [
        drone.id in drawn and drawn[drone.id].curve.end_time < along_paths[drone.id].curve.end_time - LEAST_GAIN_S
        for drone in scene.drones
    ]
    paths = [waypoints_from_paths(scene, travel, drone, route).points for drone, route in enumerate(bundles)]
    num_samples = samples.shape[1]
    if not any(is_sooner) or max(map(len, paths)) > num_samples:
        return None
    padded = [np.concatenate([path, np.repeat(path[-1:], num_samples - len(path), axis=0)]) for path in paths]
    return np.where(np.array(is_sooner)[:, None, None], samples, np.stack(padded))


def _threads(requests: Sequence[Request]) -> AbstractContextManager[None]:
    from learned.networks.threads import threads_for

    return threads_for(sum(request.scene.num_drones + request.scene.num_tasks for request in requests))


def _decisions(student: Network, scenes: Sequence[Scene]) -> tuple[list[FloatArray | None], AgentTokens | None]:
    """For each scene (N, M) the head's probabilities, None without tasks or where they are not finite; and the tokens.

    There are no tokens where no scene has a task.
    """
    from learned.student.inference import decide
    from learned.student.scenes.batch import collate_agents

    if not any(scene.num_tasks for scene in scenes):
        return [None] * len(scenes), None
    probabilities, tokens = decide(student, collate_agents(scenes))
    return [one if one.size and np.isfinite(one).all() else None for one in probabilities], tokens


def _drawings(
    student: Network, requests: Sequence[Request], found: Sequence[Bundles], tokens: AgentTokens | None
) -> list[DrawnFleet | None]:
    """Each fleet drawn and pulled taut; None where a drone has more legs than there are samples: then the paths are flown."""
    from learned.student.inference import draw
    from learned.student.pulling import pulled_samples

    bases = [_example(student, request.scene, bundles) for request, bundles in zip(requests, found, strict=True)]
    places = [place for place, base in enumerate(bases) if base is not None]
    known = tokens if tokens is None or len(places) == len(bases) else type(tokens)(*(part[places] for part in tokens))
    seeds = [requests[place].seed for place in places]
    examples = [base for base in bases if base is not None]
    drawings = draw(student, examples, steps=STEPS, tries=TRIES, seed=seeds, tokens=known)
    result: list[DrawnFleet | None] = [None] * len(bases)
    for place, drawing in zip(places, drawings, strict=True):
        result[place] = replace(drawing, samples=pulled_samples(drawing.example, drawing.samples))
    return result


def _example(student: Network, scene: Scene, bundles: Bundles) -> Example | None:
    """What is drawn on, if the student can draw it."""
    from learned.student.scenes.examples import example

    if bundles.status == "infeasible":
        return None
    try:
        return example(scene, bundles.routes, student.settings.num_samples)
    except SettingsError:
        return None
