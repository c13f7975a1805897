"""Demonstrations (`learned.demonstrations`) as examples for the student."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flockopt.geometry import BOX, CYLINDER, FloatArray
from flockopt.scene import Bounds, Box, Cylinder, Drone, Obstacle, Scene, Sphere, Task
from learned.shards import Demonstration
from learned.student.examples import Example, example, with_ways

__all__ = ["example_of", "scene_of"]


def scene_of(demonstration: Demonstration) -> Scene:
    """The scene that was demonstrated in."""
    drones = zip(
        demonstration.starts.tolist(), demonstration.capacities.tolist(), demonstration.radii.tolist(),
        demonstration.limits.tolist(), strict=True,
    )  # fmt: skip
    tasks = zip(demonstration.tasks.tolist(), demonstration.demands.tolist(), strict=True)
    return Scene(
        name=f"{demonstration.family}-{demonstration.seed}",
        bounds=Bounds(*demonstration.bounds.tolist()),
        drones=tuple(
            Drone(f"d{index}", start, load, radius, *limits) for index, (start, load, radius, limits) in enumerate(drones)
        ),
        tasks=tuple(Task(f"t{index}", place, demand) for index, (place, demand) in enumerate(tasks)),
        obstacles=tuple(_obstacle(f"o{index}", row) for index, row in enumerate(demonstration.obstacles)),
        clearance=demonstration.clearance,
        separation=demonstration.separation,
    )


def _obstacle(name: str, row: FloatArray) -> Obstacle:
    """The inverse of an obstacle's ``row``."""
    kind, x, y, z, half_x, half_y, half_z, cos_yaw, sin_yaw = row.tolist()
    if kind == BOX:
        return Box(name, (x, y, z), (2 * half_x, 2 * half_y, 2 * half_z), math.atan2(sin_yaw, cos_yaw))
    if kind == CYLINDER:
        return Cylinder(name, (x, y, z), half_x, 2 * half_z)
    return Sphere(name, (x, y, z), half_x)


def example_of(demonstration: Demonstration, num_samples: int) -> Example:
    """An example that learns from the demonstrated legs, and from the bundles where they are good ones."""
    base = example(scene_of(demonstration), demonstration.teacher_bundles, num_samples)
    ways = zip(demonstration.teacher_paths, demonstration.teacher_stops, strict=True)
    legs = [_legs(path, stops) for path, stops in ways]
    return with_ways(base, legs, teaches_allocation=not demonstration.hard)


def _legs(path: FloatArray, stops: Sequence[int]) -> list[FloatArray]:
    """A drone's vertices (V, 3) split at its tasks."""
    at = np.flatnonzero(np.asarray(stops) >= 0)
    return [path[first : last + 1] for first, last in zip([0, *at], at, strict=False)]
