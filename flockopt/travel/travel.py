"""Travel: shortest obstacle-avoiding distances between starts, tasks and ends, and the paths behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SettingsError
from flockopt.geometry.distances import distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.scene.scene import POSITION_TOLERANCE_M

__all__ = ["END", "REVISION", "START", "Paths", "Travel", "places", "stops_of", "straight_travel"]

#: Which way of finding ways lengths come from. Shortest ways are found to within a tolerance, so another revision finds
#: slightly other ones: it rises with every change of them.
REVISION = 2

#: Names of a drone's own start and end where a task index is expected.
START, END = -1, -2


@dataclass(frozen=True, eq=False)
class Paths:
    """The polylines of the legs that are not straight.

    Attributes:
        points: (P, 3) m: the tasks, the drones' starts, the drones' ends (NaN where a route ends at its last task).
        keys: per class of drone, (L,) rising ``i * P + j`` of the legs i < j that bend.
        offsets: per class, (L + 1,) where each leg's bends begin.
        bends: per class, (B, 3) m, inner vertices from point i to point j.
    """

    points: FloatArray
    keys: tuple[NDArray[np.int64], ...] = ()
    offsets: tuple[NDArray[np.int64], ...] = ()
    bends: tuple[FloatArray, ...] = ()

    def between(self, drone_class: int, i: int, j: int) -> FloatArray:
        """Vertices (V, 3) m of the leg from point i to point j, both included."""
        low, high = min(i, j), max(i, j)
        inner = np.empty((0, 3))
        if drone_class < len(self.keys):
            keys, key = self.keys[drone_class], low * len(self.points) + high
            place = int(np.searchsorted(keys, key))
            if place < len(keys) and keys[place] == key:
                offsets = self.offsets[drone_class]
                inner = self.bends[drone_class][offsets[place] : offsets[place + 1]]
        path = np.concatenate([self.points[low : low + 1], inner, self.points[high : high + 1]])
        return path if i <= j else path[::-1].copy()


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
        paths: The polylines behind the distances; None where only distances are known.
    """

    start_task: FloatArray  # (N, M) m
    task_task: FloatArray  # (C, M, M) m
    task_end: FloatArray  # (N, M) m
    start_end: FloatArray  # (N,) m
    drone_class: NDArray[np.int64]  # (N,)
    paths: Paths | None = None

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

    def of_tasks(self, tasks: Sequence[int]) -> Travel:
        """The distances of some of the tasks, in this order, without paths."""
        chosen = list(tasks)
        starts, ends = (np.ascontiguousarray(legs[:, chosen]) for legs in (self.start_task, self.task_end))
        between = np.ascontiguousarray(self.task_task[:, chosen][:, :, chosen])
        return Travel(starts, between, ends, self.start_end, self.drone_class)

    def path(self, drone: int, origin: int, target: int) -> FloatArray:
        """The polyline of one leg, as long as its entry in the matrices.

        Args:
            drone: Index of the drone that flies it.
            origin: Task index, `START` or `END`.
            target: Task index, `START` or `END`.

        Returns:
            (V, 3) m, both ends included; (1, 3) where the leg goes nowhere, also to the end of a route that
            ends at its last task; (0, 3) where there is no way.

        Raises:
            SettingsError: If this travel holds distances only.
        """
        if self.paths is None:
            raise SettingsError("paths", "is None", "paths come with compute_travel(scene)", "compute the travel there")
        i, j = self._point(drone, origin), self._point(drone, target)
        points = self.paths.points
        if np.isnan(points[[i, j]]).any():
            i = j = i if np.isnan(points[j]).any() else j
        if i == j or np.array_equal(points[i], points[j]):
            return points[i : i + 1].copy()
        if not np.isfinite(self._leg_length(drone, origin, target)):
            return np.empty((0, 3))
        return self.paths.between(int(self.drone_class[drone]), i, j)

    def _point(self, drone: int, place: int) -> int:
        num_drones, num_tasks = self.start_task.shape
        return place if place >= 0 else num_tasks + drone + (num_drones if place == END else 0)

    def _leg_length(self, drone: int, origin: int, target: int) -> float:
        if origin >= 0 and target >= 0:
            return float(self.task_task[self.drone_class[drone], origin, target])
        task = max(origin, target)
        if task < 0:
            return float(self.start_end[drone])
        return float(self.start_task[drone, task] if START in (origin, target) else self.task_end[drone, task])

    def unreachable(self, scene: Scene) -> list[tuple[int, str]]:
        """Tasks that some drone has the capacity for, yet none of those has a way to: index and reason."""
        able = scene.capacities[:, None] >= scene.demands[None, :]  # (N, M)
        cut_off = able.any(axis=0) & ~(able & np.isfinite(self.start_task)).any(axis=0)
        return [(int(task), _reason(scene, int(task), able[:, task])) for task in np.flatnonzero(cut_off)]


def _reason(scene: Scene, task: int, able: NDArray[np.bool_]) -> str:
    head = f"task {scene.tasks[task].id!r} cannot be reached by any drone that could carry it"
    if not scene.obstacles:
        return head
    gaps = distances(scene.obstacle_table, scene.task_positions[task])[0]
    nearest = int(gaps.argmin())
    need = float(scene.radii[able].min()) + scene.clearance
    obstacle = f"obstacle {scene.obstacles[nearest].id!r}"
    if gaps[nearest] < need - POSITION_TOLERANCE_M:
        return f"{head}: {obstacle} is {gaps[nearest]:.3g} m away, and radius + clearance is at least {need:.3g} m"
    return f"{head}: walled in, with {obstacle} {gaps[nearest]:.3g} m away the nearest; widen a gap to over {2 * need:.3g} m"


def stops_of(scene: Scene, drone: int, route: Sequence[int]) -> list[int]:
    """Where a drone goes: `START`, its tasks in order, and `END` if it has an end."""
    return [START, *route] + ([END] if scene.drones[drone].end_point is not None else [])


def straight_travel(scene: Scene) -> Travel:
    """Straight-line distances, blind to obstacles."""
    tasks = scene.task_positions
    start_task = np.linalg.norm(scene.starts[:, None] - tasks[None], axis=-1)
    task_end = np.nan_to_num(np.linalg.norm(scene.ends[:, None] - tasks[None], axis=-1), nan=0.0)
    start_end = np.nan_to_num(np.linalg.norm(scene.ends - scene.starts, axis=-1), nan=0.0)
    task_task = np.linalg.norm(tasks[:, None] - tasks[None], axis=-1)[None]
    classes = np.zeros(scene.num_drones, dtype=np.int64)
    return Travel(start_task, task_task, task_end, start_end, classes, Paths(places(scene)))


def places(scene: Scene) -> FloatArray:
    """Tasks, starts and ends, (M + 2 N, 3) m, as in `Paths.points`."""
    return np.concatenate([scene.task_positions, scene.starts, scene.ends])
