"""Travel: shortest obstacle-avoiding distances between starts, tasks and ends, and the paths behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.geometry import FloatArray
from flockopt.scene import Scene

__all__ = ["END", "START", "Travel", "straight_travel"]

#: Names of a drone's own start and end where a task index is expected.
START, END = -1, -2


@dataclass(frozen=True, eq=False)
class Travel:
    """Distances a fleet travels, metres; infinite where there is no way.

    Drones of one radius need the same room, so they share a task-to-task matrix: memory grows with the number
    of different radii, not with drones x tasks**2.

    Attributes:
        start_task: (N, M) from each drone's start to each task.
        task_task: (C, M, M) between tasks, for each class of drone; symmetric, zero on the diagonal.
        task_end: (N, M) from each task to each drone's end; 0 where its route ends at the last task.
        start_end: (N,) what a drone travels that serves no task: start to end, 0 where it has no end.
        drone_class: (N,) which matrix of ``task_task`` a drone uses.
    """

    start_task: FloatArray  # (N, M) m
    task_task: FloatArray  # (C, M, M) m
    task_end: FloatArray  # (N, M) m
    start_end: FloatArray  # (N,) m
    drone_class: NDArray[np.int64]  # (N,)

    def route_length(self, drone: int, tasks: Sequence[int]) -> float:
        """What drone ``drone`` travels to serve ``tasks`` in this order, metres."""
        if not len(tasks):
            return float(self.start_end[drone])
        between = self.task_task[self.drone_class[drone]]
        inner = between[list(tasks[:-1]), list(tasks[1:])].sum()
        return float(self.start_task[drone, tasks[0]] + inner + self.task_end[drone, tasks[-1]])

    def total(self, routes: Sequence[Sequence[int]]) -> float:
        """What the whole fleet travels on these routes, metres."""
        return float(sum(self.route_length(drone, tasks) for drone, tasks in enumerate(routes)))


def straight_travel(scene: Scene) -> Travel:
    """Straight-line distances, blind to obstacles."""
    tasks = scene.task_positions
    start_task = np.linalg.norm(scene.starts[:, None] - tasks[None], axis=-1)
    task_end = np.nan_to_num(np.linalg.norm(scene.ends[:, None] - tasks[None], axis=-1), nan=0.0)
    start_end = np.nan_to_num(np.linalg.norm(scene.ends - scene.starts, axis=-1), nan=0.0)
    task_task = np.linalg.norm(tasks[:, None] - tasks[None], axis=-1)[None]
    return Travel(start_task, task_task, task_end, start_end, np.zeros(scene.num_drones, dtype=np.int64))
