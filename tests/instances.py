"""Random small fleets for tests that compare with slower methods."""

from __future__ import annotations

import dataclasses

import numpy as np

from flockopt.scene import Bounds, Drone, Scene, Task
from flockopt.travel import Travel
from flockopt.travel.travel import straight_travel

SIDE_M = np.array([20.0, 20.0, 5.0])

#: So small that bodies at random places do not overlap.
RADIUS_M = 1e-3


def random_scene(
    rng: np.random.Generator,
    *,
    drones: int,
    tasks: int,
    capacity: int | list[int],
    ends: bool = False,
    demands: bool = False,
    max_distance: float | None = None,
) -> Scene:
    """Uniform starts and tasks; with ``ends`` a mix of open, returning and placed ends; ``demands`` of 1 to 3."""
    capacities = capacity if isinstance(capacity, list) else [capacity] * drones

    def point() -> tuple[float, ...]:
        return tuple(float(x) for x in rng.uniform(0, 1, 3) * SIDE_M)

    fleet = []
    for i in range(drones):
        end = (None, "start", point())[int(rng.integers(3))] if ends else None
        fleet.append(Drone(f"d{i}", point(), capacities[i], RADIUS_M, 2.0, 4.0, 30.0, end=end, max_distance=max_distance))
    places = [Task(f"t{j}", point(), int(rng.integers(1, 4)) if demands else 1) for j in range(tasks)]
    return Scene("random", Bounds((0.0, 0.0, 0.0), tuple(SIDE_M)), tuple(fleet), tuple(places))


def random_instance(rng: np.random.Generator, **settings: object) -> tuple[Scene, Travel]:
    """`random_scene` with straight-line travel."""
    scene = random_scene(rng, **settings)
    return scene, straight_travel(scene)


def with_cut_legs(rng: np.random.Generator, travel: Travel, share: float) -> Travel:
    """The same travel with a share of its legs cut: no way between those places."""
    task_task = travel.task_task.copy()
    cut = np.triu(rng.uniform(size=task_task.shape[1:]) < share, 1)
    task_task[:, cut | cut.T] = np.inf
    start_task = np.where(rng.uniform(size=travel.start_task.shape) < share, np.inf, travel.start_task)
    return dataclasses.replace(travel, start_task=start_task, task_task=task_task)
