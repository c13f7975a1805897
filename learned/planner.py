"""The planners that the learned allocators register: ``magnnet``, ``magnnet-bundling`` and ``teacher``.

They fly the paths asked for: any-angle ones, or A*'s on a voxel grid as in the paper (``voxel26``, ``voxel6``), whose
costs the allocator then sees as well. ``teacher`` refines its bundles; ``magnnet`` gives each drone one task at most and
says so of the others.
"""

from __future__ import annotations

from functools import cache, partial
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from flockopt.allocate.explain import explained
from flockopt.bundles import Bundles
from flockopt.errors import MissingExtra
from flockopt.geometry import FloatArray
from flockopt.plan import ANY_ANGLE, Planner, Proposal, Request
from flockopt.scene import Scene
from flockopt.trajectory.tracking_margin import roomier
from flockopt.travel import Travel
from learned.rollout import route_legs
from learned.ways import PATHS, LegPlanner, find_ways

if TYPE_CHECKING:
    from learned.teacher.allocators import Allocator

__all__ = ["bundles_of", "control_points", "magnnet", "magnnet_bundling", "teacher", "teacher_unrefined"]

#: What MAGNNET says of the tasks it leaves.
ONE_TASK_EACH = "magnnet gives each drone one task at most; plan with magnnet-bundling"


@cache
def _allocator(method: str) -> Allocator:
    try:
        from learned.teacher.allocators import load_allocator
    except ImportError as fault:
        raise MissingExtra(fault.name or "torch", "learned") from None
    return load_allocator(method)


def _propose(request: Request, method: str) -> Proposal:
    """Bundles by a learned allocator, and the paths asked for as control points where they are not the any-angle ones."""
    began = perf_counter()
    ways = find_ways(request.scene, request.paths, travel=request.travel)
    asked = perf_counter()
    (allocation,) = _allocator(method).bundles([request.scene], [ways.travel])
    bundles = bundles_of(request.scene, ways.travel, allocation.routes, method)
    allocated = perf_counter()
    samples = None
    if request.paths != ANY_ANGLE and bundles.status != "infeasible":
        leg = ways.leg
        if request.tracking_margin_m > 0.0:
            margins = request.tracking_margin_m, 2.0 * request.tracking_margin_m
            room, inside = roomier(request.scene, request.travel, bundles, *margins)
            leg = find_ways(room, request.paths, travel=inside).leg
        samples = control_points(request.scene, bundles, leg)
    timing = {"oracle": asked - began, "policy": allocated - asked, "legs": perf_counter() - allocated}
    return Proposal(bundles, samples, timing, episode_steps=allocation.steps)


def bundles_of(scene: Scene, travel: Travel, routes: tuple[tuple[int, ...], ...], method: str) -> Bundles:
    """A learned allocator's routes as bundles, each task it leaves with the reason.

    They are infeasible only where no allocator could do better: a policy that leaves tasks has not proven anything.
    """
    bundles = explained(scene, travel, routes)
    if bundles.status != "infeasible" or not _is_possible(scene, travel):
        return bundles
    if method == "magnnet":
        return Bundles(routes, tuple((task, ONE_TASK_EACH) for task, _ in bundles.unserved))
    return Bundles(routes, bundles.unserved)


def _is_possible(scene: Scene, travel: Travel) -> bool:
    """Whether nothing is known that keeps every allocation from serving all tasks."""
    fits = scene.demands.sum() <= scene.capacities.sum() and (scene.demands <= scene.capacities.max(initial=0)).all()
    return bool(fits) and not travel.unreachable(scene) and bool(np.isfinite(travel.start_end).all())


def control_points(scene: Scene, bundles: Bundles, leg: LegPlanner) -> FloatArray:
    """The corners of all drones' legs as samples (N, T, 3) m, the last ones repeated where a drone has fewer."""
    paths = [
        np.concatenate([scene.starts[drone : drone + 1], *(path[1:] for path in route_legs(scene, drone, route, leg))])
        for drone, route in enumerate(bundles)
    ]
    most = max(2, *map(len, paths))
    return np.stack([np.concatenate([path, np.repeat(path[-1:], most - len(path), axis=0)]) for path in paths])


def _planner(method: str) -> Planner:
    planner = partial(_propose, method=method)
    planner.paths = PATHS  # type: ignore[attr-defined]
    return planner


magnnet = _planner("magnnet")
magnnet_bundling = _planner("magnnet-bundling")
teacher = _planner("teacher")
teacher_unrefined = _planner("teacher-unrefined")
