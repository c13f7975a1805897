"""Allocation problems as padded tensors: what the learned allocators see of scenes and their travel.

Scenes of different sizes share a batch: shorter ones are padded, and masks say what is there. Drones of several classes
(radii) keep the task-to-task matrix of their class, as in `flockopt.travel.Travel`: ``task_task`` has an axis of
classes, and ``drone_class`` says which one a drone uses. Fleets of one class have one matrix, so they pay nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flockopt.errors import SettingsError
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["Problems", "length_scale", "open_problems", "random_capacities", "random_problems"]

#: Sides of the space that obstacle-free problems are drawn from: those of the scene families, metres.
SIDES_M = (20.0, 20.0, 5.0)

#: The height drones start from in the scene families, metres.
TAKE_OFF_M = 0.5


@dataclass(frozen=True, eq=False)
class Problems:
    """A batch of allocation problems; lengths in metres, float32, infinite where there is no way.

    Padded drones have no capacity and padded tasks are marked in ``task_mask``; what stands in padded places is zero.

    Attributes:
        starts: (B, N, 3) m.
        tasks: (B, M, 3) m.
        capacity: (B, N) total demand a drone can serve.
        demand: (B, M).
        max_distance: (B, N) m, infinite where there is no limit.
        start_task: (B, N, M) m.
        task_task: (B, C, M, M) m, for each class of drones.
        task_end: (B, N, M) m, 0 where routes end at their last task.
        start_end: (B, N) m.
        drone_class: (B, N) int64.
        drone_mask: (B, N) bool, false where padded.
        task_mask: (B, M) bool, false where padded.
        scale: (B,) m, see `length_scale`.
    """

    starts: Tensor
    tasks: Tensor
    capacity: Tensor
    demand: Tensor
    max_distance: Tensor
    start_task: Tensor
    task_task: Tensor
    task_end: Tensor
    start_end: Tensor
    drone_class: Tensor
    drone_mask: Tensor
    task_mask: Tensor
    scale: Tensor

    def __len__(self) -> int:
        return len(self.scale)

    @property
    def num_drones(self) -> int:
        """N, padding included."""
        return self.capacity.shape[1]

    @property
    def num_tasks(self) -> int:
        """M, padding included."""
        return self.demand.shape[1]

    def __getitem__(self, rows: Tensor | slice) -> Problems:
        return Problems(*(tensor[rows] for tensor in self._tensors()))

    def replace(self, **changes: Tensor) -> Problems:
        """A copy with some tensors exchanged."""
        return dataclasses.replace(self, **changes)

    def _tensors(self) -> list[Tensor]:
        return [getattr(self, field.name) for field in dataclasses.fields(self)]

    @staticmethod
    def cat(parts: Sequence[Problems]) -> Problems:
        """One batch from several of equal padded sizes."""
        return Problems(*(torch.cat(tensors) for tensors in zip(*(part._tensors() for part in parts), strict=True)))

    @staticmethod
    def of(scenes: Sequence[Scene], travels: Sequence[Travel]) -> Problems:
        """A batch from scenes and their travel, padded to the largest.

        Raises:
            SettingsError: If there is no scene, or not one travel for each.
        """
        if not scenes or len(scenes) != len(travels):
            value = f"holds {len(travels)} for {len(scenes)} scenes"
            raise SettingsError("travels", value, "must hold one for each scene, of at least one", "compute them all")
        drones = max(scene.num_drones for scene in scenes)
        tasks = max(scene.num_tasks for scene in scenes)
        classes = max(len(travel.task_task) for travel in travels)
        rows = [_row(scene, travel) for scene, travel in zip(scenes, travels, strict=True)]
        shapes = _shapes(drones, tasks, classes)
        stacked = {name: torch.from_numpy(np.stack([_padded(row[name], shapes[name]) for row in rows])) for name in shapes}
        return Problems(**stacked, scale=length_scale(**{name: stacked[name] for name in SCALE_FIELDS}))


#: What the length scale is computed from.
SCALE_FIELDS = ("start_task", "task_task", "drone_mask", "task_mask")


def _shapes(drones: int, tasks: int, classes: int) -> dict[str, tuple[int, ...]]:
    """The padded shape of each tensor of one problem, all but ``scale``."""
    return {
        "starts": (drones, 3), "tasks": (tasks, 3), "capacity": (drones,), "demand": (tasks,), "max_distance": (drones,),
        "start_task": (drones, tasks), "task_task": (classes, tasks, tasks), "task_end": (drones, tasks),
        "start_end": (drones,), "drone_class": (drones,), "drone_mask": (drones,), "task_mask": (tasks,),
    }  # fmt: skip


def _row(scene: Scene, travel: Travel) -> dict[str, np.ndarray[Any, Any]]:
    limits = [np.inf if drone.max_distance is None else drone.max_distance for drone in scene.drones]
    floats = {
        "starts": scene.starts, "tasks": scene.task_positions, "capacity": scene.capacities, "demand": scene.demands,
        "max_distance": np.array(limits), "start_task": travel.start_task, "task_task": travel.task_task,
        "task_end": travel.task_end, "start_end": travel.start_end,
    }  # fmt: skip
    return {
        **{name: values.astype(np.float32) for name, values in floats.items()},
        "drone_class": travel.drone_class,
        "drone_mask": np.ones(scene.num_drones, dtype=np.bool_),
        "task_mask": np.ones(scene.num_tasks, dtype=np.bool_),
    }


def _padded(values: np.ndarray[Any, Any], shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    result = np.zeros(shape, dtype=values.dtype)
    result[tuple(slice(size) for size in values.shape)] = values
    return result


def length_scale(*, start_task: Tensor, task_task: Tensor, drone_mask: Tensor, task_mask: Tensor) -> Tensor:
    """(B,) m: how far a task is from the nearest other place, on average over a problem's tasks.

    Lengths divided by it look alike in small and large, dense and sparse scenes, which makes what is learned at one size
    worth something at others. Where places coincide it is at least a thousandth of the mean leg, and 1 without any leg.
    """
    real = task_mask[:, :, None] & task_mask[:, None, :] & ~torch.eye(task_mask.shape[1], dtype=torch.bool)
    between = torch.where(real, task_task.amin(dim=1), torch.inf)  # (B, M, M), of the class with the shortest way
    from_start = torch.where(drone_mask[:, :, None] & task_mask[:, None, :], start_task, torch.inf)  # (B, N, M)
    everything = torch.cat([between, from_start], dim=1)  # (B, M + N, M)
    nearest = everything.amin(dim=1)  # (B, M)
    scale = _finite_mean(nearest)
    least = 1e-3 * _finite_mean(everything.flatten(1))
    scale = torch.maximum(scale, least)
    return torch.where(scale > 0.0, scale, 1.0)


def _finite_mean(values: Tensor) -> Tensor:
    """(B,) means of the finite entries of (B, K); 0 where there is none."""
    finite = values.isfinite()
    return torch.where(finite, values, 0.0).sum(dim=1) / finite.sum(dim=1).clamp(min=1)


def open_problems(starts: Tensor, tasks: Tensor, capacity: Tensor, start_task: Tensor, task_task: Tensor) -> Problems:
    """Problems of equal size with one class of drones, unit demands and routes that end at their last task.

    Args:
        starts: (B, N, 3) m.
        tasks: (B, M, 3) m.
        capacity: (B, N).
        start_task: (B, N, M) m.
        task_task: (B, M, M) m.
    """
    count, num_drones, num_tasks = start_task.shape
    masks = {
        "drone_mask": torch.ones(count, num_drones, dtype=torch.bool),
        "task_mask": torch.ones(count, num_tasks, dtype=torch.bool),
    }
    lengths = {"start_task": start_task, "task_task": task_task[:, None]}
    return Problems(
        starts=starts, tasks=tasks, capacity=capacity, demand=torch.ones(count, num_tasks),
        max_distance=torch.full((count, num_drones), torch.inf), task_end=torch.zeros(count, num_drones, num_tasks),
        start_end=torch.zeros(count, num_drones), drone_class=torch.zeros(count, num_drones, dtype=torch.int64),
        scale=length_scale(**lengths, **masks), **lengths, **masks,
    )  # fmt: skip


def random_problems(count: int, drones: int, tasks: int, generator: torch.Generator) -> Problems:
    """Problems without obstacles, drawn uniformly in the space of the scene families; cheap and endless.

    Args:
        count: B.
        drones: N.
        tasks: M.
        generator: Of everything random.
    """
    sides = torch.tensor(SIDES_M)
    starts = torch.rand(count, drones, 3, generator=generator) * sides
    starts[..., 2] = TAKE_OFF_M
    targets = torch.rand(count, tasks, 3, generator=generator) * sides
    capacity = random_capacities(count, drones, tasks, generator)
    return open_problems(starts, targets, capacity, torch.cdist(starts, targets), torch.cdist(targets, targets))


def random_capacities(count: int, drones: int, tasks: int, generator: torch.Generator) -> Tensor:
    """(B, N) capacities that hold all tasks.

    Half of the fleets are as the scene families make them, ceil(M / N) + 1 each; a quarter have one less or one more; in
    a quarter drones differ by up to one from each other.
    """
    base = -(-tasks // drones)
    kind = torch.randint(0, 8, (count, 1), generator=generator)
    spare = torch.ones(count, 1).masked_fill(kind == 0, 0.0).masked_fill(kind == 1, 2.0)
    mixed = torch.randint(-1, 2, (count, drones), generator=generator) * (kind >= 6)
    return base + spare + mixed
