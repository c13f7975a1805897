"""What every allocation method is given: a scene, its travel, and settings, all checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from flockopt.bundles.bundles import Bundles
from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["AllocationRequest", "RouteTuple", "checked_limits", "checked_preferences", "checked_routes"]

#: Task indices in visiting order, by drone.
RouteTuple: TypeAlias = tuple[tuple[int, ...], ...]


@dataclass(frozen=True, eq=False)
class AllocationRequest:
    """An allocation to be made.

    Attributes:
        scene: The scene.
        travel: Its travel.
        preferences: (N, M) >= 0, or None.
        warm_start: Routes to begin with, one a drone; or none at all.
        iterations: Where to stop, or None.
        time_limit_s: Where to stop, or None.
        seed: Of whatever is random.
    """

    scene: Scene
    travel: Travel
    preferences: FloatArray | None = None
    warm_start: RouteTuple = ()
    iterations: int | None = None
    time_limit_s: float | None = None
    seed: int = 0


def checked_limits(iterations: int | None, time_limit_s: float | None, seed: int) -> None:
    """Raise a `SettingsError` unless the limits and the seed may be used."""
    if iterations is not None and not (_is_integer(iterations) and iterations >= 0):
        raise SettingsError(
            "iterations", f"is {iterations!r}", "must be an integer >= 0 or None", "name a number or leave it out"
        )
    if time_limit_s is not None and not (_is_number(time_limit_s) and 0 < time_limit_s < math.inf):
        rule = "must be a finite number > 0 or None"
        raise SettingsError("time_limit_s", f"is {time_limit_s!r}", rule, "name seconds or leave it out")
    if not (_is_integer(seed) and seed >= 0):
        raise SettingsError("seed", f"is {seed!r}", "must be an integer >= 0", "choose another")


def checked_preferences(scene: Scene, task_probs: FloatArray | Sequence[Sequence[float]] | None) -> FloatArray | None:
    """(N, M) preferences, or None where there are none.

    Raises:
        SettingsError: Naming ``task_probs[i][j]`` where an entry is not a finite number >= 0.
    """
    if task_probs is None:
        return None
    shape = (scene.num_drones, scene.num_tasks)
    try:
        preferences = np.array(task_probs, dtype=np.float64)
    except (TypeError, ValueError):
        raise SettingsError("task_probs", "is not an array of numbers", f"must have shape {shape}", "pass numbers") from None
    if preferences.shape != shape:
        rule = f"must have shape {shape}: drones x tasks"
        raise SettingsError("task_probs", f"has shape {preferences.shape}", rule, "give one row for each drone")
    bad = np.argwhere(~(np.isfinite(preferences) & (preferences >= 0.0)))
    if len(bad):
        i, j = bad[0]
        rule = "preferences are finite numbers >= 0"
        raise SettingsError(f"task_probs[{i}][{j}]", f"is {preferences[i, j]:g}", rule, "use 0 to mask a drone out")
    return preferences


def checked_routes(scene: Scene, warm_start: Bundles | Sequence[Sequence[int]] | None) -> RouteTuple:
    """The routes to begin with as tuples, or () where there are none.

    Raises:
        SettingsError: Naming ``warm_start[i][r]`` where it is not a task or is one for the second time.
    """
    if warm_start is None:
        return ()
    routes = tuple(tuple(route) for route in warm_start)
    if len(routes) != scene.num_drones:
        rule = f"must have one for each drone: {scene.num_drones}"
        raise SettingsError("warm_start", f"has {len(routes)} routes", rule, "add empty routes or drop some")
    seen: set[int] = set()
    for i, route in enumerate(routes):
        for r, task in enumerate(route):
            if not (_is_integer(task) and 0 <= task < scene.num_tasks) or task in seen:
                rule = f"tasks are integers in [0, {scene.num_tasks}), each at most once"
                raise SettingsError(f"warm_start[{i}][{r}]", f"is {task!r}", rule, "take it out")
            seen.add(task)
    return tuple(tuple(int(task) for task in route) for route in routes)


def _is_integer(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)
