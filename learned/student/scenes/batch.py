"""Batches of scenes as padded tensors, with masks that say what is there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from flockopt.geometry.distances import OBSTACLE_COLUMNS
from flockopt.scene import Scene
from learned.networks.obstacle_distance import signed_distance
from learned.student.scenes.examples import Example

__all__ = ["NOTHING", "FleetBatch", "WayBatch", "collate", "collate_agents", "with_nothing_else"]

#: The index of no task and of no drone.
NOTHING = -1

#: Where padded obstacles are put, metres: too far away to matter.
FAR_AWAY_M = 1e6

#: Obstacles that a drone drawn on its own is told of, and the samples of its way from which the nearest are looked for.
MOST_OBSTACLES, THINNING = 12, 4

Record = TypeVar("Record", "WayBatch", "FleetBatch")


@dataclass(frozen=True)
class WayBatch:
    """The straight ways through bundles, and what stands beside them. B scenes, N drones, T samples, K obstacles.

    Attributes:
        straight: (B, N, T, 3) m.
        leg_index, leg_begin, leg_end: (B, N, T), see `learned.student.scenes.examples.Example`.
        blocked: (B, N, T) bool.
        active: (B, N) bool, drones that go anywhere.
        needs: (B, N) m, how far each drone's centre stays from obstacles.
        obstacles: (B, K, 9), rows as in `flockopt.geometry.distances.OBSTACLE_COLUMNS`.
        obstacle_mask: (B, K) bool.
        lower, upper: (B, 3) m.
        target: (B, N, T, 3) m, or None.
    """

    straight: Tensor
    leg_index: Tensor
    leg_begin: Tensor
    leg_end: Tensor
    blocked: Tensor
    active: Tensor
    needs: Tensor
    obstacles: Tensor
    obstacle_mask: Tensor
    lower: Tensor
    upper: Tensor
    target: Tensor | None = None

    @property
    def centre(self) -> Tensor:
        """(B, 3) m, the middle of each scene's bounds."""
        return (self.lower + self.upper) / 2

    @property
    def half_extent(self) -> Tensor:
        """(B,) m, half the longest side of each scene's bounds."""
        return (self.upper - self.lower).amax(dim=-1) / 2

    def scaled(self, points: Tensor) -> Tensor:
        """Points (B, ..., 3) m about the middle of their scene, in halves of its longest side."""
        shape = (-1, *[1] * (points.dim() - 2))
        return (points - self.centre.view(*shape, 3)) / self.half_extent.view(*shape, 1)

    def unscaled(self, points: Tensor) -> Tensor:
        """The inverse of `scaled`, metres."""
        shape = (-1, *[1] * (points.dim() - 2))
        return points * self.half_extent.view(*shape, 1) + self.centre.view(*shape, 3)

    def rows(self, scene: Tensor, drone: Tensor) -> WayBatch:
        """Some drones, each as a scene of its own: ``drone`` (R,) of ``scene`` (R,) becomes R scenes with one drone.

        Of the obstacles only those nearest to the blocked legs stay, at most `MOST_OBSTACLES`.
        """
        per_scene = {name: getattr(self, name)[scene] for name in ("obstacles", "obstacle_mask", "lower", "upper")}
        fields = ("straight", "leg_index", "leg_begin", "leg_end", "blocked", "active", "needs")
        per_drone = {name: getattr(self, name)[scene, drone] for name in fields}
        if self.obstacles.shape[1] > MOST_OBSTACLES:
            points, blocked = per_drone["straight"][:, ::THINNING], per_drone["blocked"][:, ::THINNING]  # (R, T / 4, ...)
            gaps = signed_distance(per_scene["obstacles"][:, None], points[:, :, None])  # (R, T / 4, K)
            nearest = gaps.masked_fill(~blocked[..., None], FAR_AWAY_M).amin(dim=1).topk(MOST_OBSTACLES, largest=False)
            index = nearest.indices.sort(dim=1).values  # (R, most)
            per_scene["obstacles"] = per_scene["obstacles"].gather(1, index[..., None].expand(-1, -1, len(OBSTACLE_COLUMNS)))
            per_scene["obstacle_mask"] = per_scene["obstacle_mask"].gather(1, index)
        target = None if self.target is None else self.target[scene, drone][:, None]
        return WayBatch(**{name: value[:, None] for name, value in per_drone.items()}, **per_scene, target=target)


@dataclass(frozen=True)
class FleetBatch:
    """B scenes, padded to the most drones N, tasks M, obstacles K and tasks in a bundle R.

    Attributes:
        starts, ends: (B, N, 3) m; an end is the start where there is none.
        has_end: (B, N) bool.
        capacities: (B, N).
        drone_mask: (B, N) bool.
        tasks: (B, M, 3) m.
        demands: (B, M).
        task_mask: (B, M) bool.
        bundles: (B, N, R) task indices, `NOTHING` where there is none.
        assignment: (B, M) the drone that serves each task, or `NOTHING`.
        teaches_allocation: (B,) bool.
        ways: The straight ways, and the obstacles.
    """

    starts: Tensor
    ends: Tensor
    has_end: Tensor
    capacities: Tensor
    drone_mask: Tensor
    tasks: Tensor
    demands: Tensor
    task_mask: Tensor
    bundles: Tensor
    assignment: Tensor
    teaches_allocation: Tensor
    ways: WayBatch

    def mirrored(self, generator: torch.Generator) -> FleetBatch:
        """Every scene mirrored in x, in y and in the line x = y, each by the toss of a coin."""
        tosses = torch.rand(len(self.starts), 3, generator=generator).to(self.starts.device) < 0.5
        corners = torch.stack([_mirror(self.ways.lower, tosses), _mirror(self.ways.upper, tosses)])
        obstacles = self.ways.obstacles.clone()
        obstacles[..., 1:4] = _mirror(obstacles[..., 1:4], tosses)
        obstacles[..., 7:9] = _mirror(obstacles[..., 7:9], tosses)  # a box is its own mirror image: its axis says it all
        ways = dataclasses.replace(
            self.ways,
            straight=_mirror(self.ways.straight, tosses),
            obstacles=obstacles,
            lower=corners.amin(dim=0),
            upper=corners.amax(dim=0),
            target=None if self.ways.target is None else _mirror(self.ways.target, tosses),
        )
        starts, ends, tasks = (_mirror(places, tosses) for places in (self.starts, self.ends, self.tasks))
        return dataclasses.replace(self, ways=ways, starts=starts, ends=ends, tasks=tasks)

    def to(self, device: torch.device) -> FleetBatch:
        """The same on another device."""
        return _moved(dataclasses.replace(self, ways=_moved(self.ways, device)), device)


def _moved(record: Record, device: torch.device) -> Record:
    tensors = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    moved: dict[str, Any] = {name: value.to(device) for name, value in tensors.items() if isinstance(value, Tensor)}
    return dataclasses.replace(record, **moved)


def _mirror(vectors: Tensor, tosses: Tensor) -> Tensor:
    """Vectors (B, ..., 2 or 3) mirrored by ``tosses`` (B, 3)."""
    shape = (len(vectors), *[1] * (vectors.dim() - 2))
    flip_x, flip_y, swap = (toss.view(shape) for toss in tosses.unbind(dim=1))
    x = torch.where(flip_x, -vectors[..., 0], vectors[..., 0])
    y = torch.where(flip_y, -vectors[..., 1], vectors[..., 1])
    turned = torch.stack([torch.where(swap, y, x), torch.where(swap, x, y)], dim=-1)
    return torch.cat([turned, vectors[..., 2:]], dim=-1)


def collate(examples: Sequence[Example], multiple: int = 1) -> FleetBatch:
    """Examples of any sizes as one padded batch. The target is there if all of them have one.

    Numbers of drones, tasks, obstacles and tasks in a bundle are rounded up to a multiple: where many batches follow each
    other, few shapes spare the backend making code for each.
    """
    scenes = [one.scene for one in examples]
    agents, needs_and_bounds = _agents(scenes, multiple)
    num_drones, num_tasks = agents["drone_mask"].shape[1], agents["task_mask"].shape[1]
    num_obstacles = _rounded_up(max([1, *(len(scene.obstacles) for scene in scenes)]), multiple)
    bundle_size = _rounded_up(max([1, *(len(route) for one in examples for route in one.routes)]), multiple)
    bundles = np.full((len(examples), num_drones, bundle_size), NOTHING)
    assignment = np.full((len(examples), num_tasks), NOTHING)
    for index, one in enumerate(examples):
        for drone, route in enumerate(one.routes):
            bundles[index, drone, : len(route)] = route
            assignment[index, list(route)] = drone
    targets = [one.target for one in examples if one.target is not None]
    ways = WayBatch(
        straight=_padded([one.straight for one in examples], num_drones),
        leg_index=_padded([one.leg_index for one in examples], num_drones),
        leg_begin=_padded([one.leg_begin for one in examples], num_drones),
        leg_end=_padded([one.leg_end for one in examples], num_drones),
        blocked=_padded([one.blocked for one in examples], num_drones),
        active=_padded([one.active for one in examples], num_drones),
        obstacles=_padded([scene.obstacle_table for scene in scenes], num_obstacles, fill=FAR_AWAY_M),
        obstacle_mask=_mask([len(scene.obstacles) for scene in scenes], num_obstacles),
        target=_padded(targets, num_drones) if len(targets) == len(examples) else None,
        **needs_and_bounds,
    )
    return FleetBatch(
        bundles=torch.from_numpy(bundles),
        assignment=torch.from_numpy(assignment),
        teaches_allocation=torch.tensor([one.teaches_allocation for one in examples]),
        ways=ways,
        **agents,
    )


def collate_agents(scenes: Sequence[Scene]) -> FleetBatch:
    """Scenes of any sizes before there are bundles: what an allocation head reads of them. The other tensors are empty."""
    agents, needs_and_bounds = _agents(scenes)
    return with_nothing_else(agents | needs_and_bounds)


def with_nothing_else(tensors: dict[str, Tensor]) -> FleetBatch:
    """A batch of some tensors of a batch or its ways, by name; the others are empty, and there is no target."""
    empty = torch.empty(0)
    ways, batch = (
        {field.name: tensors.get(field.name, empty) for field in dataclasses.fields(kind)} for kind in (WayBatch, FleetBatch)
    )
    del ways["target"], batch["ways"]
    return FleetBatch(**batch, ways=WayBatch(**ways))


def _agents(scenes: Sequence[Scene], multiple: int = 1) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """What is known of drones, tasks and bounds: fields of a `FleetBatch`, and of its `WayBatch`."""
    drones, tasks = [scene.num_drones for scene in scenes], [scene.num_tasks for scene in scenes]
    num_drones, num_tasks = _rounded_up(max(drones), multiple), _rounded_up(max([1, *tasks]), multiple)
    has_end = [np.isfinite(scene.ends[:, 0]) for scene in scenes]
    ends = [np.where(there[:, None], scene.ends, scene.starts) for there, scene in zip(has_end, scenes, strict=True)]
    agents = {
        "starts": _padded([scene.starts for scene in scenes], num_drones),
        "ends": _padded(ends, num_drones),
        "has_end": _padded(has_end, num_drones),
        "capacities": _padded([scene.capacities for scene in scenes], num_drones),
        "drone_mask": _mask(drones, num_drones),
        "tasks": _padded([scene.task_positions for scene in scenes], num_tasks),
        "demands": _padded([scene.demands for scene in scenes], num_tasks),
        "task_mask": _mask(tasks, num_tasks),
    }
    needs_and_bounds = {
        "needs": _padded([scene.radii + scene.clearance for scene in scenes], num_drones, fill=1.0),
        "lower": torch.tensor([scene.bounds.lower for scene in scenes], dtype=torch.float32),
        "upper": torch.tensor([scene.bounds.upper for scene in scenes], dtype=torch.float32),
    }
    return agents, needs_and_bounds


def _rounded_up(count: int, multiple: int) -> int:
    return -(-count // multiple) * multiple


def _padded(arrays: Sequence[np.ndarray], length: int, fill: float = 0.0) -> Tensor:
    """(B, length, ...): arrays stacked, their first axis filled up; floats as float32, other kinds as they are."""
    dtype = np.dtype(np.float32) if arrays[0].dtype.kind == "f" else arrays[0].dtype
    result = np.empty((len(arrays), length, *arrays[0].shape[1:]), dtype=dtype)
    for index, array in enumerate(arrays):
        result[index, : len(array)] = array
        result[index, len(array) :] = fill
    return torch.from_numpy(result)


def _mask(counts: Sequence[int], length: int) -> Tensor:
    return torch.from_numpy(np.arange(length) < np.array(counts)[:, None])
