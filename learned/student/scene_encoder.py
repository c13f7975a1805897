"""The scene graph network: drones and tasks exchange messages, obstacles are tokens of their own."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from flockopt.geometry import BOX, CYLINDER, SPHERE
from learned.student.batch import FleetBatch

__all__ = ["SceneEncoder", "SceneTokens", "drone_features", "obstacle_features", "task_features"]

NUM_DRONE_FEATURES, NUM_TASK_FEATURES, NUM_OBSTACLE_FEATURES = 11, 4, 11


@dataclass(frozen=True)
class SceneTokens:
    """H_G in the paper, by kind; rows of padding are zero.

    Attributes:
        drones: (B, N, D).
        tasks: (B, M, D).
        obstacles: (B, K, D).
        mask: (B, N + M + K) bool, of all of them in this order.
    """

    drones: Tensor
    tasks: Tensor
    obstacles: Tensor
    mask: Tensor

    @property
    def all(self) -> Tensor:
        """(B, N + M + K, D)."""
        return torch.cat([self.drones, self.tasks, self.obstacles], dim=1)


def drone_features(batch: FleetBatch) -> Tensor:
    """(B, N, 11): start, way to the end, whether it has one, load, share of the fleet's capacity, need, number."""
    start, end = batch.ways.scaled(batch.starts), batch.ways.scaled(batch.ends)
    mask = batch.drone_mask
    total_capacity = (batch.capacities * mask).sum(dim=1, keepdim=True).clamp(min=1.0)
    total_demand = (batch.demands * batch.task_mask).sum(dim=1, keepdim=True)
    num_drones = mask.sum(dim=1, keepdim=True).to(start.dtype)
    scalars = [
        batch.has_end.to(start.dtype),
        (total_demand / total_capacity).expand_as(batch.capacities),
        batch.capacities / total_capacity * num_drones,
        10.0 * batch.ways.needs / batch.ways.half_extent[:, None],
        (num_drones / 10.0).expand_as(batch.capacities),
    ]
    return torch.cat([start, end - start, torch.stack(scalars, dim=-1)], dim=-1)


def task_features(batch: FleetBatch) -> Tensor:
    """(B, M, 4): position, demand as a share of all capacity, per drone."""
    capacity = (batch.capacities * batch.drone_mask).sum(dim=1, keepdim=True).clamp(min=1.0)
    num_drones = batch.drone_mask.sum(dim=1, keepdim=True)
    return torch.cat([batch.ways.scaled(batch.tasks), (batch.demands / capacity * num_drones)[..., None]], dim=-1)


def obstacle_features(batch: FleetBatch) -> Tensor:
    """(B, K, 11): centre, half extents, double angle of the yaw, kind; padding is zero."""
    table = batch.ways.obstacles
    centre = batch.ways.scaled(table[..., 1:4])
    halves = table[..., 4:7] / batch.ways.half_extent[:, None, None]
    kinds = torch.stack([table[..., 0] == kind for kind in (BOX, CYLINDER, SPHERE)], dim=-1).to(table.dtype)
    features = torch.cat([centre, halves, double_yaw(table), kinds], dim=-1)
    return features.masked_fill(~batch.ways.obstacle_mask[..., None], 0.0)


def double_yaw(table: Tensor) -> Tensor:
    """Cosine and sine of twice the yaw of obstacles (..., 9), which half a turn leaves as they are."""
    cos_yaw, sin_yaw = table[..., 7], table[..., 8]
    return torch.stack([cos_yaw**2 - sin_yaw**2, 2.0 * cos_yaw * sin_yaw], dim=-1)


class MessageRound(nn.Module):
    """One round of h_u <- act(W_s h_u + mean over neighbours v of W_n h_v); maps differ by kind of node and edge.

    Tasks hear drones; drones hear tasks and drones. The neighbour term of an isolated node is zero.
    """

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.drone_self = nn.Linear(hidden, hidden)
        self.task_self = nn.Linear(hidden, hidden)
        self.drone_to_task = nn.Linear(hidden, hidden, bias=False)
        self.task_to_drone = nn.Linear(hidden, hidden, bias=False)
        self.drone_to_drone = nn.Linear(hidden, hidden, bias=False)

    def forward(self, drones: Tensor, tasks: Tensor, drone_mask: Tensor, task_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Drones (B, N, H) and tasks (B, M, H) after the round; masks (B, N), (B, M)."""
        present = drone_mask[..., None].to(drones.dtype)
        everyone = self.drone_to_drone(drones) * present
        others = (present.sum(dim=1, keepdim=True) - present).clamp(min=1.0)
        fleet = (everyone.sum(dim=1, keepdim=True) - everyone) / others
        from_tasks = _masked_mean(self.task_to_drone(tasks), task_mask)
        from_drones = _masked_mean(self.drone_to_task(drones), drone_mask)
        heard = nn.functional.silu(self.drone_self(drones) + fleet + from_tasks)
        told = nn.functional.silu(self.task_self(tasks) + from_drones)
        return heard, told


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """(B, 1, H): the mean of (B, U, H) over what the mask (B, U) holds; zero where that is nothing."""
    present = mask[..., None].to(values.dtype)
    return (values * present).sum(dim=1, keepdim=True) / present.sum(dim=1, keepdim=True).clamp(min=1.0)


class SceneEncoder(nn.Module):
    """Scene tokens of a batch; of any number of drones, tasks and obstacles."""

    def __init__(self, hidden: int, rounds: int, width: int) -> None:
        super().__init__()
        self.drone_in = nn.Linear(NUM_DRONE_FEATURES, hidden)
        self.task_in = nn.Linear(NUM_TASK_FEATURES, hidden)
        self.rounds = nn.ModuleList(MessageRound(hidden) for _ in range(rounds))
        self.drone_out = nn.Linear(hidden, width)
        self.task_out = nn.Linear(hidden, width)
        self.obstacle = nn.Sequential(nn.Linear(NUM_OBSTACLE_FEATURES, hidden), nn.SiLU(), nn.Linear(hidden, width))

    def forward(self, batch: FleetBatch) -> SceneTokens:
        """Tokens of width D."""
        drones = nn.functional.silu(self.drone_in(drone_features(batch)))  # (B, N, H)
        tasks = nn.functional.silu(self.task_in(task_features(batch)))  # (B, M, H)
        for message_round in self.rounds:
            drones, tasks = message_round(drones, tasks, batch.drone_mask, batch.task_mask)
        obstacles = self.obstacle(obstacle_features(batch))  # (B, K, D)
        masks = batch.drone_mask, batch.task_mask, batch.ways.obstacle_mask
        tokens = self.drone_out(drones), self.task_out(tasks), obstacles
        kept = [part.masked_fill(~mask[..., None], 0.0) for part, mask in zip(tokens, masks, strict=True)]
        return SceneTokens(*kept, mask=torch.cat(masks, dim=1))
