"""The allocation methods that benchmarks compare, by name: ``search-20ms``, ``exact``, ``module:function``, ..."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import numpy as np

from benchmarks.peers import solve_pyvrp
from flockopt import Scene, SettingsError, refine_bundles
from flockopt.bundles import Bundles
from flockopt.bundles.exact.exact import solve_exact
from flockopt.bundles.explain import explained
from flockopt.travel import Travel

__all__ = ["ALLOCATORS", "AllocationMethod", "allocator", "nearest_task"]

#: Allocates a scene, given its travel and a seed.
AllocationMethod: TypeAlias = Callable[[Scene, Travel, int], Bundles]


def _refined(method: str, scene: Scene, travel: Travel, seed: int, time_limit_s: float | None) -> Bundles:
    return refine_bundles(scene, travel=travel, method=method, seed=seed, time_limit_s=time_limit_s)


def _greedy(scene: Scene, travel: Travel, seed: int, time_limit_s: float | None) -> Bundles:
    """The construction that the search begins with."""
    return refine_bundles(scene, travel=travel, method="search", iterations=0, seed=seed)


def nearest_task(scene: Scene, travel: Travel, seed: int, time_limit_s: float | None = None) -> Bundles:
    """Again and again the shortest way of any drone, from where it is, to any open task it has room for."""
    routes: list[list[int]] = [[] for _ in scene.drones]
    left, is_open = scene.capacities.copy(), np.ones(scene.num_tasks, dtype=np.bool_)
    ahead = travel.start_task.copy()  # (N, M) m
    while True:
        allowed = is_open[None] & (scene.demands[None] <= left[:, None])
        costs = np.where(allowed, ahead, np.inf)
        drone, task = (int(place) for place in np.unravel_index(costs.argmin(), costs.shape)) if costs.size else (0, 0)
        if not costs.size or not np.isfinite(costs[drone, task]):
            return explained(scene, travel, tuple(map(tuple, routes)))
        routes[drone].append(task)
        left[drone] -= scene.demands[task]
        is_open[task] = False
        ahead[drone] = travel.task_task[travel.drone_class[drone], task]


def _exact(scene: Scene, travel: Travel, seed: int, time_limit_s: float | None) -> Bundles:
    return solve_exact(scene, travel, time_limit_s=time_limit_s, seed=seed).bundles


def _pyvrp(scene: Scene, travel: Travel, seed: int, time_limit_s: float | None) -> Bundles:
    return solve_pyvrp(scene, travel, 1.0 if time_limit_s is None else time_limit_s, seed)


#: Methods by name; each takes the time that its name ends in.
ALLOCATORS: dict[str, Callable[[Scene, Travel, int, float | None], Bundles]] = {
    "search": partial(_refined, "search"),
    "ortools": partial(_refined, "cvrp"),
    "exact": _exact,
    "lp": partial(_refined, "lp"),
    "greedy": _greedy,
    "nearest": nearest_task,
    "pyvrp": _pyvrp,
}


def allocator(name: str) -> AllocationMethod:
    """The method called ``NAME``, ``NAME-20ms`` or ``NAME-1.5s``, or the function ``module:function``.

    Raises:
        SettingsError: If there is none of this name.
    """
    if ":" in name:
        return pkgutil.resolve_name(name)
    parts = re.fullmatch(r"([a-z]+)(?:-([0-9.]+)(ms|s))?", name)
    if parts is None or parts[1] not in ALLOCATORS:
        rule = f"must be one of {', '.join(ALLOCATORS)}, with a time such as -20ms or not, or module:function"
        raise SettingsError("methods", f"holds {name!r}", rule, "choose one")
    time_limit_s = None if parts[2] is None else float(parts[2]) / (1e3 if parts[3] == "ms" else 1.0)
    method = ALLOCATORS[parts[1]]
    return lambda scene, travel, seed: method(scene, travel, seed, time_limit_s)
