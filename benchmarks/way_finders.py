"""The pipelines that `benchmarks.scalability` compares: each from a scene in memory to ways that are clear, on the clock."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from time import perf_counter, process_time
from typing import TypeAlias

import numpy as np
import torch

from flockopt import Scene, generate, refine_bundles
from flockopt.bundles import Bundles
from flockopt.errors import MissingExtra
from flockopt.flights.waypoints import waypoints_from_samples
from flockopt.planning.planners import PLANNERS, Request
from flockopt.records.arrays import FloatArray
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel
from flockopt.travel.travel import straight_travel
from learned.paths.rollout import route_legs
from learned.paths.voxels import VoxelSettings, voxel_oracle
from learned.student.backends.choice import network
from learned.student.inference import DrawnFleet, Network, decide
from learned.student.network.model import Student
from learned.student.network.rows import rows_of
from learned.student.planner import STEPS, drawn_plans, searched_plan, shipped_student
from learned.student.pulling import ways_of
from learned.student.scenes.batch import collate
from learned.student.scenes.examples import example
from learned.teacher.planner import MAGNNET_BUNDLING

__all__ = ["BATCHES", "NAMES", "OPENVINO", "UNSEEN", "Clock", "WayFinder", "WaysFound", "way_finders"]

#: Added to the seeds, so that no scene is one of the demonstrations, whose seeds start at 0.
UNSEEN = 60_000_000

#: Scenes that are planned in one pass, and the first seed of those that fill a batch up.
BATCH, COMPANY = 16, 70_000_000

OPENVINO, BATCHES = "learned, openvino", f"learned, batches of {BATCH}"

NAMES = ("learned", OPENVINO, BATCHES, "hybrid", "classical", "voxel6", "voxel26", "voxel6-greedy")


@dataclass(frozen=True)
class WaysFound:
    """What a pipeline made of a scene.

    Attributes:
        bundles: Which drone visits what.
        length: Metres, of the ways.
        ways_s: CPU seconds to the ways.
        wall_s: The same on the wall.
        travel: To decode with; None for pipelines that are not decoded.
        samples: (N, T, 3) m control points, where the ways come from a student.
        clear_before: Whether no way had to be mended.
    """

    bundles: Bundles
    length: float
    ways_s: float
    wall_s: float
    travel: Travel | None = None
    samples: FloatArray | None = None
    clear_before: bool = True


class Clock:
    """Runs from when it is made."""

    def __init__(self) -> None:
        self._cpu_s, self._wall_s = process_time(), perf_counter()

    def read(self) -> tuple[float, float]:
        """CPU seconds and seconds on the wall."""
        return process_time() - self._cpu_s, perf_counter() - self._wall_s


def by_learning(student: Network, scene: Scene, seed: int, company: Sequence[Scene] = ()) -> WaysFound:
    """The student without any search for paths, unless a way comes out blocked.

    With company, other scenes that are planned in the same pass, seconds are one scene's share.
    """
    clock = Clock()
    requests = [Request(one, straight_travel(one), None, seed) for one in (scene, *company)]
    fleets = []
    for request, (bundles, drawing, _) in zip(requests, drawn_plans(student, requests), strict=True):
        travel, fleet = request.travel, _drawn(request.scene, drawing)
        if not fleet.clear.all():
            travel = compute_travel(request.scene, routes=bundles.routes)
        fleets.append((_mended(request.scene, bundles, fleet, travel), bundles, travel, fleet))
    shares = [seconds / len(requests) for seconds in clock.read()]
    return _drawn_outcome(*fleets[0], *shares)


def by_batches(student: Network, family: str, scene: Scene, seed: int) -> WaysFound:
    """`by_learning` of as many scenes at a time as `BATCH`, all of one size."""
    return by_learning(student, scene, seed, _company(family, scene.num_drones, scene.num_tasks))


@cache
def _company(family: str, drones: int, tasks: int) -> list[Scene]:
    """The scenes that fill a batch up."""
    return [generate(family, drones=drones, tasks=tasks, seed=COMPANY + number) for number in range(BATCH - 1)]


def by_both(student: Network, scene: Scene, seed: int) -> WaysFound:
    """The hybrid: searches over any-angle travel, and the student's ways."""
    clock = Clock()
    travel = compute_travel(scene)
    bundles, drawing, _ = searched_plan(student, Request(scene, travel, None, seed))
    fleet = _drawn(scene, drawing)
    ways = _mended(scene, bundles, fleet, travel)
    return _drawn_outcome(ways, bundles, travel, fleet, *clock.read())


def _drawn(scene: Scene, drawing: DrawnFleet | None) -> DrawnFleet:
    """What was drawn; every scene of the benchmark can be."""
    if drawing is None:
        raise RuntimeError(f"{scene.name} has more legs a drone than the student has samples")
    return drawing


def _mended(scene: Scene, bundles: Bundles, drawing: DrawnFleet, travel: Travel) -> list[FloatArray]:
    """The drawn ways, with shortest paths where they are blocked."""
    ways = ways_of(drawing.example, drawing.samples)
    for drone in np.flatnonzero(~drawing.clear):
        mended = waypoints_from_samples(scene, travel, int(drone), bundles.routes[drone], drawing.samples[drone])
        ways[drone] = mended.points
    return ways


def _drawn_outcome(
    ways: list[FloatArray], bundles: Bundles, travel: Travel, drawing: DrawnFleet, ways_s: float, wall_s: float
) -> WaysFound:
    return WaysFound(bundles, sum(map(_length, ways)), ways_s, wall_s, travel, drawing.samples, bool(drawing.clear.all()))


def classically(scene: Scene, seed: int) -> WaysFound:
    """Any-angle travel and search."""
    clock = Clock()
    travel = compute_travel(scene)
    bundles = PLANNERS["classical"].propose(Request(scene, travel, None, seed)).bundles
    for drone, route in enumerate(bundles):
        route_legs(scene, drone, route, travel.path)
    seconds = clock.read()
    return WaysFound(bundles, travel.total(bundles.routes), *seconds, travel)


def on_voxels(paths: str, scene: Scene, seed: int) -> WaysFound:
    """Dijkstra's costs, MAGNNET + bundling, A* legs."""
    clock = Clock()
    proposal = MAGNNET_BUNDLING.propose(Request(scene, straight_travel(scene), None, seed, paths=paths))
    seconds = clock.read()
    return WaysFound(proposal.bundles, sum(map(_length, np.asarray(proposal.samples))), *seconds)


def greedily_on_voxels(scene: Scene, seed: int) -> WaysFound:
    """6-connected Dijkstra's costs, greedy bundles, A* legs."""
    clock = Clock()
    oracle = voxel_oracle(scene, VoxelSettings(6))
    bundles = refine_bundles(scene, travel=oracle.travel, iterations=0, seed=seed)
    ways = [leg for drone, route in enumerate(bundles) for leg in route_legs(scene, drone, route, oracle.leg)]
    seconds = clock.read()
    return WaysFound(bundles, sum(map(_length, ways)), *seconds)


def _length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


WayFinder: TypeAlias = Callable[[Scene, int], WaysFound]


def way_finders(family: str) -> dict[str, WayFinder]:
    """The pipelines by name; without OpenVINO's where that is not installed."""
    student = shipped_student()
    torch_student = network(student, "torch")
    pipelines: dict[str, WayFinder] = {"learned": partial(by_learning, torch_student)}
    try:
        pipelines[OPENVINO] = partial(by_learning, _compiled(student))
    except MissingExtra as fault:
        print(f"benchmarks.scalability: {fault}", file=sys.stderr)
    return pipelines | {
        BATCHES: partial(by_batches, torch_student, family),
        "hybrid": partial(by_both, torch_student),
        "classical": classically,
        "voxel6": partial(on_voxels, "voxel6"),
        "voxel26": partial(on_voxels, "voxel26"),
        "voxel6-greedy": greedily_on_voxels,
    }


def _compiled(student: Student) -> Network:
    """The student by OpenVINO, its sampler compiled for one to eight drones at a time before any clock runs."""
    compiled = network(student, "openvino-f32")
    scene = generate("forest", drones=10, tasks=20, seed=UNSEEN)
    one = example(scene, refine_bundles(scene, travel=straight_travel(scene), iterations=0).routes)
    _, tokens = decide(compiled, collate([one]))
    for count in (1, 2, 4, 8):
        places = [(0, drone) for drone in range(count)]
        noise = torch.zeros(count, student.settings.num_samples, 3)
        for steps in STEPS:
            compiled.sample(rows_of(student.settings, tokens, [one], places), noise, steps)
    return compiled
