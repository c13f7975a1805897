"""The planners that the learned allocators register: ``magnnet``, ``magnnet-bundling`` and ``teacher``.

They fly the paths asked for: any-angle ones, or A*'s on a voxel grid as in the paper (``voxel26``, ``voxel6``), whose
costs the allocator then sees as well. ``magnnet`` gives each drone one task at most and says so of the others. ``teacher``
inserts what its policy left, which is nothing unless demands or ranges differ, and refines the bundles by local search
(`learned.teacher.refinement`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from flockopt.bundles import Bundles
from flockopt.bundles.explain import explained
from flockopt.bundles.refine import refine_bundles
from flockopt.bundles.request import RouteTuple
from flockopt.errors import require
from flockopt.planning.margins import roomier
from flockopt.planning.planners import ANY_ANGLE, Proposal, Request
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel
from learned.networks.planners import planner_of_many
from learned.networks.shipped import load_once
from learned.paths.rollout import route_legs
from learned.paths.ways import PATHS, LegPlanner, find_ways

if TYPE_CHECKING:
    from learned.teacher.allocators import Allocator

__all__ = [
    "MAGNNET", "MAGNNET_BUNDLING", "TEACHER", "TEACHER_UNREFINED", "allocator", "bundles_of", "control_points", "refined",
]  # fmt: skip

#: What MAGNNET says of the tasks it leaves.
ONE_TASK_EACH = "magnnet gives each drone one task at most; plan with magnnet-bundling"


def allocator(method: str) -> Allocator:
    """A learned allocator with the weights that come with the package, loaded once.

    Raises:
        SettingsError: If the weights are missing or damaged.
        MissingExtra: If torch or safetensors is not installed.
    """
    require("torch", extra="learned")
    from learned.teacher.allocators import load_allocator

    return load_once(load_allocator, method)


def _propose(requests: Sequence[Request], method: str, refines: bool = False) -> list[Proposal]:
    """Bundles by a learned allocator, and the paths asked for as control points where they are not the any-angle ones.

    The networks decide for all requests at once; the seconds of a stage that they share are shared evenly.
    """
    began = perf_counter()
    ways = [find_ways(request.scene, request.paths, travel=request.travel) for request in requests]
    asked = perf_counter()
    scenes, travels = [request.scene for request in requests], [way.travel for way in ways]
    allocations = allocator(method).bundles(scenes, travels)
    decided = perf_counter()
    routes = [allocation.routes for allocation in allocations]
    if refines:
        complete = [  # what is left is inserted
            refine_bundles(scene, travel=travel, warm_start=some, iterations=0).routes
            for scene, travel, some in zip(scenes, travels, routes, strict=True)
        ]
        routes = refined(scenes, travels, complete)
    found = [bundles_of(scene, travel, some, method) for scene, travel, some in zip(scenes, travels, routes, strict=True)]
    allocated = perf_counter()
    stages = {"oracle": asked - began, "policy": decided - asked, "refine": allocated - decided}
    shares = {stage: seconds / len(requests) for stage, seconds in stages.items()}
    proposals = []
    for request, way, bundles, allocation in zip(requests, ways, found, allocations, strict=True):
        before = perf_counter()
        samples = _samples(request, way.leg, bundles)
        timing = shares | {"legs": perf_counter() - before}
        proposals.append(Proposal(bundles, samples, timing, episode_steps=allocation.steps))
    return proposals


def _samples(request: Request, leg: LegPlanner, bundles: Bundles) -> FloatArray | None:
    """The paths asked for as control points, None where they are the any-angle ones."""
    if request.paths == ANY_ANGLE or bundles.status == "infeasible":
        return None
    if request.tracking_margin_m > 0.0:
        margins = request.tracking_margin_m, 2.0 * request.tracking_margin_m
        roomier_scene, roomier_travel = roomier(request.scene, request.travel, bundles, *margins)
        leg = find_ways(roomier_scene, request.paths, travel=roomier_travel).leg
    return control_points(request.scene, bundles, leg)


def refined(scenes: Sequence[Scene], travels: Sequence[Travel], routes: Sequence[RouteTuple]) -> list[RouteTuple]:
    """Bundles of many scenes after the teacher's refinement.

    Raises:
        MissingExtra: If torch is not installed.
    """
    require("torch", extra="learned")
    from learned.teacher.refinement import refine

    return refine(scenes, travels, routes)


def bundles_of(scene: Scene, travel: Travel, routes: RouteTuple, method: str) -> Bundles:
    """A learned allocator's routes as bundles, each task it leaves with the reason.

    What only a policy leaves is not proven to be left: such bundles are incomplete (`flockopt.bundles.explain`).
    """
    bundles = explained(scene, travel, routes)
    if bundles.status != Status.INCOMPLETE or method != "magnnet":
        return bundles
    unserved = tuple((task, ONE_TASK_EACH) for task, _ in bundles.unserved)
    return Bundles(routes, unserved, Status.INCOMPLETE, ONE_TASK_EACH)


def control_points(scene: Scene, bundles: Bundles, leg: LegPlanner) -> FloatArray:
    """The corners of all drones' legs as samples (N, T, 3) m, the last ones repeated where a drone has fewer."""
    paths = [
        np.concatenate([scene.starts[drone : drone + 1], *(path[1:] for path in route_legs(scene, drone, route, leg))])
        for drone, route in enumerate(bundles)
    ]
    most = max(2, *map(len, paths))
    return np.stack([np.concatenate([path, np.repeat(path[-1:], most - len(path), axis=0)]) for path in paths])


MAGNNET = planner_of_many(partial(_propose, method="magnnet"), "magnnet", paths=PATHS)
MAGNNET_BUNDLING = planner_of_many(partial(_propose, method="magnnet-bundling"), "magnnet-bundling", paths=PATHS)
TEACHER = planner_of_many(partial(_propose, method="teacher", refines=True), "teacher", paths=PATHS)
TEACHER_UNREFINED = planner_of_many(partial(_propose, method="teacher"), "teacher-unrefined", paths=PATHS)
