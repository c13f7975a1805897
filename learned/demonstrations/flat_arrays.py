"""Demonstrations in memory: flat arrays of many scenes, and one scene's part of them.

Scenes differ in size, so what belongs to drones, tasks and obstacles stands in one row for all scenes, and
``*_offsets`` say where each scene's part begins. docs/demonstrations.md lists every array.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.bundles import Bundles
from flockopt.geometry.distances import BOX, CYLINDER
from flockopt.records.arrays import FloatArray
from flockopt.scene import Bounds, Box, Cylinder, Drone, Obstacle, Scene, Sphere, Task

__all__ = ["LAYOUT", "OFFSETS", "Demonstration", "Demonstrations"]

#: Name, kind of number and shape of every array: S scenes; N drones, M tasks and K obstacles of all of them; V vertices of
#: all their paths; T samples.
LAYOUT: dict[str, tuple[type[np.generic], tuple[int | str, ...]]] = {
    "seed": (np.int64, ("S",)), "family": (np.str_, ("S",)), "hard": (np.bool_, ("S",)),
    "bounds": (np.float64, ("S", 2, 3)), "clearance": (np.float64, ("S",)), "separation": (np.float64, ("S",)),
    "teacher_cost": (np.float64, ("S",)),
    "drone_offsets": (np.int64, ("S+1",)), "task_offsets": (np.int64, ("S+1",)), "obstacle_offsets": (np.int64, ("S+1",)),
    "starts": (np.float64, ("N", 3)), "capacities": (np.int64, ("N",)), "radii": (np.float64, ("N",)),
    "limits": (np.float64, ("N", 3)), "teacher_samples": (np.float32, ("N", "T", 3)),
    "tasks": (np.float64, ("M", 3)), "demands": (np.int64, ("M",)),
    "teacher_drone": (np.int64, ("M",)), "teacher_rank": (np.int64, ("M",)), "teacher_place": (np.int64, ("M",)),
    "obstacles": (np.float64, ("K", 9)),
    "vertex_offsets": (np.int64, ("N+1",)), "teacher_vertices": (np.float64, ("V", 3)), "teacher_stops": (np.int64, ("V",)),
}  # fmt: skip

#: Where parts begin, and on which axis.
OFFSETS = {"drone_offsets": "N", "task_offsets": "M", "obstacle_offsets": "K", "vertex_offsets": "V"}


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One scene with what the teacher did in it; teacher_* are the paper's starred quantities.

    Attributes:
        seed: Of the scene.
        family: Its family.
        hard: Whether the bundles are random, so that they are no example for the allocation.
        bounds: (2, 3) m.
        clearance: m.
        separation: m.
        starts: (N, 3) m.
        capacities: (N,).
        radii: (N,) m.
        limits: (N, 3) m/s, m/s², m/s³.
        tasks: (M, 3) m.
        demands: (M,).
        obstacles: (K, 9), see `flockopt.geometry.distances.OBSTACLE_COLUMNS`.
        teacher_cost: Metres flown along the legs.
        teacher_drone: (M,) which drone serves a task, -1 for none.
        teacher_rank: (M,) as its how manieth, from 0; -1 for none.
        teacher_place: (M,) at which sample it is there; -1 for none.
        teacher_samples: (N, T, 3) m.
        teacher_paths: For each drone the (V, 3) m vertices of its legs, one after another.
        teacher_stops: For each drone (V,) which task a vertex is, -1 for none.
    """

    seed: int
    family: str
    hard: bool
    bounds: FloatArray
    clearance: float
    separation: float
    starts: FloatArray
    capacities: NDArray[np.int64]
    radii: FloatArray
    limits: FloatArray
    tasks: FloatArray
    demands: NDArray[np.int64]
    obstacles: FloatArray
    teacher_cost: float
    teacher_drone: NDArray[np.int64]
    teacher_rank: NDArray[np.int64]
    teacher_place: NDArray[np.int64]
    teacher_samples: NDArray[np.float32]
    teacher_paths: tuple[FloatArray, ...]
    teacher_stops: tuple[NDArray[np.int64], ...]

    def scene(self) -> Scene:
        """The scene itself."""
        limits = zip(self.starts.tolist(), self.capacities.tolist(), self.radii.tolist(), self.limits.tolist(), strict=True)
        demands = zip(self.tasks.tolist(), self.demands.tolist(), strict=True)
        return Scene(
            name=f"{self.family}-{len(self.starts)}x{len(self.tasks)}-{self.seed}",
            bounds=Bounds(*map(tuple, self.bounds.tolist())),
            drones=tuple(
                Drone(f"d{i}", tuple(start), capacity, radius, *most)
                for i, (start, capacity, radius, most) in enumerate(limits)
            ),
            tasks=tuple(Task(f"t{j}", tuple(place), demand) for j, (place, demand) in enumerate(demands)),
            obstacles=tuple(_obstacle(f"o{k}", row) for k, row in enumerate(self.obstacles.tolist())),
            clearance=float(self.clearance),
            separation=float(self.separation),
        )

    @property
    def teacher_assignment(self) -> NDArray[np.bool_]:
        """A*: (N, M), true where drone i serves task j."""
        return np.arange(len(self.starts))[:, None] == self.teacher_drone[None]

    @property
    def teacher_bundles(self) -> Bundles:
        """B*."""
        order = np.argsort(self.teacher_rank, kind="stable")
        routes = (order[self.teacher_drone[order] == drone] for drone in range(len(self.starts)))
        return Bundles(tuple(tuple(int(task) for task in route) for route in routes))


def _obstacle(name: str, row: list[float]) -> Obstacle:
    """An obstacle from its row in a table (`flockopt.geometry.distances.OBSTACLE_COLUMNS`)."""
    shape, x, y, z, half_x, half_y, half_z, cos_yaw, sin_yaw = row
    if shape == BOX:
        return Box(name, (x, y, z), (2 * half_x, 2 * half_y, 2 * half_z), math.atan2(sin_yaw, cos_yaw))
    return Cylinder(name, (x, y, z), half_x, 2 * half_z) if shape == CYLINDER else Sphere(name, (x, y, z), half_x)


@dataclass(frozen=True, eq=False)
class Demonstrations(Sequence[Demonstration]):
    """Many demonstrations, in flat arrays (docs/demonstrations.md)."""

    arrays: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.arrays["seed"])

    def __getitem__(self, index: Any) -> Any:
        """One demonstration, its arrays being views."""
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        index = int(index) % len(self)
        cut = self._cuts[index]
        parts = {name: self.arrays[name][cut[axes[0]]] for name, (_, axes) in LAYOUT.items() if axes[0] in cut}
        at = self.arrays["vertex_offsets"][cut["N"].start : cut["N"].stop + 1]
        for field, name in (("teacher_paths", "teacher_vertices"), ("teacher_stops", "teacher_stops")):
            parts[field] = tuple(self.arrays[name][begin:end] for begin, end in pairwise(at))
        return Demonstration(**parts)

    @property
    def num_samples(self) -> int:
        """T."""
        return int(self.arrays["teacher_samples"].shape[1])

    @cached_property
    def _cuts(self) -> list[dict[int | str, Any]]:
        """Where each scene's entries are, by the axis they stand on."""
        bounds = [self.arrays[name] for name, axis in OFFSETS.items() if axis in "NMK"]
        return [
            {"S": index, **{axis: slice(at[index], at[index + 1]) for axis, at in zip("NMK", bounds, strict=True)}}
            for index in range(len(self))
        ]
