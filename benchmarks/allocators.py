"""The allocation methods that benchmarks compare, by name: ``search-20ms``, ``exact``, ``module:function``, ..."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from benchmarks.peers import solve_pyvrp
from flockopt import Scene, SettingsError, refine_bundles
from flockopt.allocate.exact import solve_exact
from flockopt.bundles import Bundles
from flockopt.travel import Travel

__all__ = ["ALLOCATORS", "Allocator", "allocator"]

#: Allocates a scene, given its travel and a seed.
Allocator: TypeAlias = Callable[[Scene, Travel, int], Bundles]


def _refined(method: str, scene: Scene, travel: Travel, seed: int, time_limit_s: float | None) -> Bundles:
    return refine_bundles(scene, travel=travel, method=method, seed=seed, time_limit_s=time_limit_s)


def _greedy(scene: Scene, travel: Travel, seed: int, time_limit_s: float | None) -> Bundles:
    """The construction that the search begins with."""
    return refine_bundles(scene, travel=travel, method="search", iterations=0, seed=seed)


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
    "pyvrp": _pyvrp,
}


def allocator(name: str) -> Allocator:
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
