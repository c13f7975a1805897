"""Scenes to allocate tasks in, with and without obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flockopt import Scene, compute_travel, generate
from flockopt.scene import Bounds, Drone, Task
from flockopt.travel import Travel
from flockopt.travel.travel import straight_travel

__all__ = ["AllocationCase", "uniform_scene"]

#: The space of scenes without obstacles.
SIZE_M = (20.0, 20.0, 5.0)

#: So small that bodies at random places do not overlap; allocations do not depend on it.
RADIUS_M = 1e-3


@dataclass(frozen=True)
class AllocationCase:
    """One scene: how many drones and tasks, with obstacles or not, and the seed."""

    drones: int
    tasks: int
    seed: int
    has_obstacles: bool

    @property
    def name(self) -> str:
        """What the rows call it."""
        return f"{'forest' if self.has_obstacles else 'open'}-{self.drones}x{self.tasks}-{self.seed}"

    @property
    def group(self) -> str:
        """What the summary calls it and its like."""
        return f"{'forest' if self.has_obstacles else 'open'} {self.drones}x{self.tasks}"

    def make(self) -> tuple[Scene, Travel]:
        """The scene and its travel."""
        if self.has_obstacles:
            scene = generate("forest", drones=self.drones, tasks=self.tasks, seed=self.seed)
            return scene, compute_travel(scene)
        scene = uniform_scene(self.drones, self.tasks, self.seed)
        return scene, straight_travel(scene)


def uniform_scene(drones: int, tasks: int, seed: int) -> Scene:
    """Starts and tasks uniform in the space; each drone can carry one task more than its share."""
    rng = np.random.default_rng(seed)
    starts, places = (rng.uniform(0.0, 1.0, (count, 3)) * SIZE_M for count in (drones, tasks))
    capacity = math.ceil(tasks / drones) + 1
    fleet = [Drone(f"d{i}", tuple(start.tolist()), capacity, RADIUS_M, 2.0, 4.0, 30.0) for i, start in enumerate(starts)]
    return Scene(
        f"uniform-{seed}",
        Bounds((0.0, 0.0, 0.0), SIZE_M),
        tuple(fleet),
        tuple(Task(f"t{j}", tuple(p.tolist())) for j, p in enumerate(places)),
    )
