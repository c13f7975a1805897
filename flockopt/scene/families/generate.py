"""Scenes from a family's name and a seed, with exactly the drones and tasks asked for."""

from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np

from flockopt.errors import SettingsError
from flockopt.geometry.distances import distances
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import Bounds, Drone, Point, Scene, Task
from flockopt.scene.families.layouts import FAMILIES, Ground, Layout
from flockopt.scene.families.settings import FamilySettings
from flockopt.scene.parts import obstacle_table

__all__ = ["generate"]

#: Families whose number of obstacles can be chosen; in the others the layout decides it.
COUNTED = ("forest", "city")

#: How many batches of candidate points in a row may bring nothing before the rest is said not to fit.
MAX_EMPTY_BATCHES = 3


def generate(family: str, *, drones: int = 10, tasks: int = 20, seed: int = 0, **settings: Any) -> Scene:
    """A scene of the family, the same for the same seed and settings, and always feasible to fly.

    Starts and tasks are at least two separations from each other, clear of obstacles by the settings' margin
    and out of doors, windows and gaps, so that a drone may hover at any of them for good; all of them lie in
    one connected space. The capacities hold all tasks.

    Args:
        family: One of `FAMILIES`.
        drones: How many, at least 1.
        tasks: How many, at least 0.
        seed: A whole number >= 0.
        **settings: Fields of `FamilySettings`.

    Raises:
        SettingsError: On an unknown family or a bad setting, or when the size set holds no such scene.
    """
    if not isinstance(family, str) or family not in FAMILIES:
        rule = f"must be one of {', '.join(FAMILIES)}"
        raise SettingsError("family", f"is {checks.shown(family)}", rule, "choose one of these")
    drones = checks.integer(SettingsError, "drones", drones, least=1)
    tasks = checks.integer(SettingsError, "tasks", tasks, least=0)
    seed = checks.integer(SettingsError, "seed", seed, least=0)
    rules = FamilySettings.from_dict(settings)
    if rules.obstacles is not None and family not in COUNTED:
        rule = f"can be set in {' and '.join(COUNTED)} only"
        raise SettingsError("obstacles", f"is {rules.obstacles} for {family}", rule, "leave it out; set size instead")
    rng = np.random.default_rng([seed, zlib.crc32(family.encode())])
    size = rules.space(drones + tasks)
    layout = FAMILIES[family](Ground(size, rules), rng)
    starts, targets = _points(rng, size, rules, layout, drones, tasks)
    capacity = math.ceil(tasks / drones) + rules.spare_capacity
    return Scene(
        name=f"{family}-{drones}x{tasks}-{seed}",
        bounds=Bounds((0.0, 0.0, 0.0), size),
        drones=tuple(_drone(index, start, capacity, rules) for index, start in enumerate(starts)),
        tasks=tuple(Task(f"t{index}", target) for index, target in enumerate(targets)),
        obstacles=layout.obstacles,
        clearance=rules.clearance,
        separation=rules.separation,
    )


def _drone(index: int, start: Point, capacity: int, rules: FamilySettings) -> Drone:
    limits = rules.max_speed, rules.max_acceleration, rules.max_jerk
    return Drone(f"d{index}", start, capacity, rules.radius, *limits)


def _points(
    rng: np.random.Generator, size: Point, rules: FamilySettings, layout: Layout, drones: int, tasks: int
) -> tuple[list[Point], list[Point]]:
    """Starts at half a door above the floor and tasks at any height."""
    inset = rules.need + rules.margin
    lower, upper = np.full(3, inset), np.array(size) - inset
    take_off = max(rules.door / 2, inset)
    low_upper = np.array([*upper[:2], take_off])
    low_lower = np.array([*lower[:2], take_off])
    starts = _scatter(rng, (low_lower, low_upper), "drones", drones, rules, layout, np.empty((0, 3)))
    targets = _scatter(rng, (lower, upper), "tasks", tasks, rules, layout, starts)
    return _tuples(starts), _tuples(targets)


def _scatter(
    rng: np.random.Generator,
    box: tuple[FloatArray, FloatArray],
    field: str,
    count: int,
    rules: FamilySettings,
    layout: Layout,
    others: FloatArray,
) -> FloatArray:
    """Points in a box, clear of obstacles and gates, spaced from each other and from ``others``; (count, 3) m."""
    points = np.concatenate([others, np.empty((count, 3))])
    num_points, full = len(others), len(points)
    empty_batches = 0
    while num_points < full and empty_batches < MAX_EMPTY_BATCHES:
        before = num_points
        batch = rng.uniform(box[0], box[1], (2 * count + 50, 3))
        # Millimetres keep scene files short; rounding comes before the checks, so that what is checked is kept.
        for point in _allowed(np.round(batch, 3), rules, layout):
            if num_points < full and _is_apart(points[:num_points], point, rules.spacing):
                points[num_points] = point
                num_points += 1
        empty_batches = empty_batches + 1 if num_points == before else 0
    if num_points == full:
        return points[len(others) :]
    found = f"is {count}, of which only {num_points - len(others)} fit"
    rule = f"starts and tasks stay {rules.spacing:g} m apart and clear of obstacles"
    raise SettingsError(field, found, rule, "ask for fewer, enlarge size or leave it out")


def _allowed(candidates: FloatArray, rules: FamilySettings, layout: Layout) -> FloatArray:
    """Those candidates with enough room to hover without closing a gate to others."""
    clear = distances(obstacle_table(layout.obstacles), candidates) >= rules.need + rules.margin
    open_gates = distances(obstacle_table(layout.gates), candidates) >= rules.separation + rules.radius
    return candidates[clear.all(axis=1) & open_gates.all(axis=1)]


def _is_apart(points: FloatArray, point: FloatArray, spacing: float) -> bool:
    return bool((np.sum((points - point) ** 2, axis=1) >= spacing**2).all())


def _tuples(points: FloatArray) -> list[Point]:
    return [(float(x), float(y), float(z)) for x, y, z in points]
