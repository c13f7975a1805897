"""`refine_bundles`: capacity-feasible ordered bundles from a scene, and from preferences where there are some."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flockopt.bundles.bundles import Bundles
from flockopt.bundles.explain import LENGTH_TOLERANCE_M, explained, may_be_overlooked
from flockopt.bundles.request import AllocationRequest, checked_limits, checked_preferences, checked_routes
from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["METHODS", "refine_bundles"]

#: Methods that begin with given routes and make them no worse.
WARM_STARTED = ("search", "cvrp")

#: Share of a time limit that is spent anew on routes that a packing gave.
AGAIN_SHARE = 0.2

#: What a preference of zero counts as, relative to the task's greatest.
LEAST_PREFERENCE = 1e-6


def refine_bundles(
    scene: Scene,
    task_probs: FloatArray | Sequence[Sequence[float]] | None = None,
    *,
    travel: Travel | None = None,
    method: str = "search",
    iterations: int | None = None,
    time_limit_s: float | None = None,
    seed: int = 0,
    warm_start: Bundles | Sequence[Sequence[int]] | None = None,
) -> Bundles:
    """Which drone visits which tasks in which order, with little travel in all.

    Each task is served once, capacities and ``max_distance`` are kept. Where that is proven impossible the status is
    ``"infeasible"``, where it was only not found ``"incomplete"``: what was found to fit is served, and the other tasks are
    named with the reason.

    Args:
        scene: The scene.
        task_probs: (N, M) preferences >= 0 of drones for tasks, such as an allocation head gives; of a column, only
            ratios count. They steer where the search begins; what it then minimises is travel alone.
        travel: Of the scene; computed when left out.
        method: One of `METHODS`.
        iterations: How long to search; equal seeds and iterations give equal bundles. Of ``cvrp``, solutions.
        time_limit_s: When to stop, if earlier. With neither limit, a number of iterations that grows with the scene.
        seed: Of the search.
        warm_start: Bundles to begin with.

    Raises:
        SettingsError: If an argument is malformed; the message names it.
    """
    if method not in METHODS:
        raise SettingsError("method", f"is {method!r}", f"must be one of {', '.join(METHODS)}", "choose one of them")
    checked_limits(iterations, time_limit_s, seed)
    preferences = checked_preferences(scene, task_probs)
    routes = checked_routes(scene, warm_start)
    if travel is None:
        from flockopt.travel.compute import compute_travel

        travel = compute_travel(scene)
    if scene.num_tasks == 0:
        return explained(scene, travel, ((),) * scene.num_drones)
    request = AllocationRequest(scene, travel, preferences, routes, iterations, time_limit_s, seed)
    bundles = METHODS[method](request)
    return _packed(request, bundles, method) if bundles.status == Status.INCOMPLETE else bundles


def _packed(request: AllocationRequest, bundles: Bundles, method: str) -> Bundles:
    """Better than bundles that leave tasks over: all tasks by a packing of their demands, or a proof that there is none."""
    from flockopt.bundles.packing import pack
    from flockopt.bundles.tour import shortest_order

    scene, travel = request.scene, request.travel
    packing = pack(scene, travel, thorough=request.iterations is None)
    if packing.is_impossible and may_be_overlooked(scene, travel):
        return bundles
    if packing.is_impossible:
        words = "no way to share the tasks out keeps every capacity, and that is proven; split a task or raise a capacity"
        return replace(
            bundles, status=Status.INFEASIBLE, reason="; ".join([words, *(reason for _, reason in bundles.unserved)])
        )
    if packing.drones is None:
        return bundles
    carried = [[task for task, drone in enumerate(packing.drones) if drone == i] for i in range(scene.num_drones)]
    routes = tuple(shortest_order(travel, i, tasks) for i, tasks in enumerate(carried))
    lengths = np.array([travel.route_length(i, route) for i, route in enumerate(routes)])
    if not (lengths <= _longest_routes(scene)).all():
        return bundles
    packed = explained(scene, travel, routes)
    if method not in WARM_STARTED:
        return packed
    left_s = None if request.time_limit_s is None else AGAIN_SHARE * request.time_limit_s
    better = METHODS[method](replace(request, warm_start=routes, time_limit_s=left_s))
    return packed if better.unserved else better


def _by_search(request: AllocationRequest) -> Bundles:
    from flockopt.bundles.bounds.one_each import carries_one_at_most, match_one_each
    from flockopt.bundles.search.anneal import search
    from flockopt.bundles.search.construct import build_problem

    if request.preferences is None and carries_one_at_most(request.scene):
        matched = match_one_each(request.scene, request.travel, _longest_routes(request.scene))
        if matched is not None:
            return explained(request.scene, request.travel, matched.routes)
    routes = search(
        build_problem(request.scene, request.travel),
        warm_start=request.warm_start,
        preference=None if request.preferences is None else _as_detour(request.travel, request.preferences),
        iterations=request.iterations,
        time_limit_s=request.time_limit_s,
        seed=request.seed,
    )
    return explained(request.scene, request.travel, routes)


def _by_assignment(request: AllocationRequest) -> Bundles:
    """The transport polytope's best assignment, each drone's tasks put in order; preferences default to nearness."""
    from flockopt.bundles.assignment import transport
    from flockopt.bundles.tour import shortest_order

    scene, travel = request.scene, request.travel
    preferences = _nearness(travel) if request.preferences is None else request.preferences
    able = np.isfinite(travel.start_task) & (scene.demands <= scene.capacities[:, None])
    assignment = transport(scene, np.where(able, preferences, 0.0)).assignment & able
    return explained(scene, travel, tuple(shortest_order(travel, i, np.flatnonzero(row)) for i, row in enumerate(assignment)))


def _by_routing(request: AllocationRequest) -> Bundles:
    from flockopt.bundles.ortools_routing import route_with_ortools

    routes = route_with_ortools(
        request.scene,
        request.travel,
        warm_start=request.warm_start,
        solutions=request.iterations,
        time_limit_s=request.time_limit_s,
    )
    return explained(request.scene, request.travel, routes)


def _exactly(request: AllocationRequest) -> Bundles:
    from flockopt.bundles.exact.exact import solve_exact

    warm_start = Bundles(request.warm_start) if request.warm_start else None
    return solve_exact(
        request.scene, request.travel, warm_start=warm_start, time_limit_s=request.time_limit_s, seed=request.seed
    ).bundles


#: The ways to make bundles. Each imports its solver when called.
METHODS: dict[str, Callable[[AllocationRequest], Bundles]] = {
    "search": _by_search,
    "lp": _by_assignment,
    "cvrp": _by_routing,
    "exact": _exactly,
}


def _longest_routes(scene: Scene) -> FloatArray:
    """(N,) m that each drone may travel, and what rounding adds."""
    limits = [np.inf if drone.max_distance is None else drone.max_distance for drone in scene.drones]
    return np.array(limits) + LENGTH_TOLERANCE_M


def _nearness(travel: Travel) -> FloatArray:
    """(N, M) preferences that fall with the distance from a drone's start."""
    legs = travel.start_task[np.isfinite(travel.start_task)]
    longest_m = float(legs.max(initial=1.0))
    return np.where(np.isfinite(travel.start_task), 1.0 - 0.999 * travel.start_task / longest_m, 0.0)


def _as_detour(travel: Travel, preferences: FloatArray) -> FloatArray:
    """(M, N) m: log-probabilities in metres, so that they weigh against travel."""
    greatest = preferences.max(axis=0)
    share = np.divide(preferences, greatest, out=np.ones_like(preferences), where=greatest > 0.0)
    legs = travel.start_task[np.isfinite(travel.start_task)]
    typical_m = float(np.median(legs)) if legs.size else 0.0
    return np.ascontiguousarray(-typical_m * np.log(np.maximum(share, LEAST_PREFERENCE)).T)
