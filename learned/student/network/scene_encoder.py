"""The scene graph network: drones and tasks exchange messages, obstacles are tokens of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from flockopt.geometry.distances import BOX, CYLINDER, SPHERE
from learned.student.scenes.batch import FleetBatch

__all__ = ["AgentTokens", "SceneEncoder", "SceneTokens", "drone_features", "obstacle_features", "task_features"]

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


class AgentTokens(NamedTuple):
    """Of the scene tokens those of drones and tasks; rows of padding are zero."""

    drones: Tensor  # (B, N, D)
    tasks: Tensor  # (B, M, D)


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

    def forward(self, drones: Tensor, tasks: Tensor, shares: Shares) -> tuple[Tensor, Tensor]:
        """Drones (B, N, H) and tasks (B, M, H) after the round. Means are taken before the maps, which comes to the same."""
        fleet = self.drone_to_drone(shares.others @ drones)
        from_tasks = self.task_to_drone(shares.tasks @ tasks)
        from_drones = self.drone_to_task(shares.drones @ drones)
        heard = nn.functional.silu(self.drone_self(drones) + fleet + from_tasks)
        told = nn.functional.silu(self.task_self(tasks) + from_drones)
        return heard, told


class Shares(NamedTuple):
    """The weights of means over neighbours; zero where there is none."""

    drones: Tensor  # (B, 1, N)
    tasks: Tensor  # (B, 1, M)
    others: Tensor  # (B, N, N), of the other drones

    @staticmethod
    def of(drone_mask: Tensor, task_mask: Tensor, dtype: torch.dtype) -> Shares:
        """From masks (B, N), (B, M) of who is there."""
        drones, tasks = drone_mask[:, None].to(dtype), task_mask[:, None].to(dtype)
        others = drones * (1.0 - torch.eye(drone_mask.shape[1], dtype=dtype, device=drone_mask.device))
        return Shares(*(present / present.sum(dim=-1, keepdim=True).clamp(min=1.0) for present in (drones, tasks, others)))


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
        drones, tasks = self.agents(batch)
        obstacles = self.obstacle(obstacle_features(batch))  # (B, K, D)
        masks = batch.drone_mask, batch.task_mask, batch.ways.obstacle_mask
        kept = _without_padding(obstacles, masks[2])
        return SceneTokens(drones, tasks, kept, mask=torch.cat(masks, dim=1))

    def agents(self, batch: FleetBatch) -> AgentTokens:
        """The tokens of drones and tasks, which do not depend on the obstacles."""
        drones = nn.functional.silu(self.drone_in(drone_features(batch)))  # (B, N, H)
        tasks = nn.functional.silu(self.task_in(task_features(batch)))  # (B, M, H)
        shares = Shares.of(batch.drone_mask, batch.task_mask, drones.dtype)
        for message_round in self.rounds:
            drones, tasks = message_round(drones, tasks, shares)
        return AgentTokens(
            _without_padding(self.drone_out(drones), batch.drone_mask),
            _without_padding(self.task_out(tasks), batch.task_mask),
        )


def _without_padding(tokens: Tensor, mask: Tensor) -> Tensor:
    """Tokens (B, U, D), zero where the mask (B, U) is false."""
    return tokens * mask[..., None]
