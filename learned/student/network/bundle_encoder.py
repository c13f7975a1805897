"""The bundle encoder: condition tokens c^B of every drone from its ordered bundle and the scene tokens."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.networks.transformer import sinusoids
from learned.student.network.scene_encoder import SceneTokens
from learned.student.scenes.batch import NOTHING, FleetBatch

__all__ = ["BundleEncoder"]


class BundleEncoder(nn.Module):
    """One token for each leg: where it leads, whose it is, which in order it is; and their mean for the drone."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.leg = nn.Sequential(nn.Linear(3 * width, width), nn.SiLU(), nn.Linear(width, width))
        self.home = nn.Linear(width, width)

    def forward(self, batch: FleetBatch, tokens: SceneTokens) -> tuple[Tensor, Tensor]:
        """Leg tokens (B, N, R + 1, D) and drone tokens (B, N, D).

        Leg r leads to the drone's r-th task, and from its last task to its end.
        """
        batch_size, num_drones, bundle_size = batch.bundles.shape
        there = batch.bundles != NOTHING  # (B, N, R)
        index = batch.bundles.clamp(min=0).flatten(1)[..., None].expand(-1, -1, self.width)
        goals = tokens.tasks.gather(1, index).view(batch_size, num_drones, bundle_size, self.width)
        there = nn.functional.pad(there, (0, 1))  # (B, N, R + 1)
        goals = nn.functional.pad(goals, (0, 0, 0, 1))
        num_legs = there.sum(dim=2) + batch.has_end.long()  # (B, N)
        return self.legs(goals, there, tokens.drones, num_legs)

    def legs(self, goals: Tensor, is_task: Tensor, drones: Tensor, num_legs: Tensor) -> tuple[Tensor, Tensor]:
        """Leg tokens (..., L, D) and drone tokens (..., D).

        Args:
            goals: (..., L, D) the tokens of the tasks that legs lead to.
            is_task: (..., L) whether there is such a task; other legs lead home.
            drones: (..., D) the drones' tokens.
            num_legs: (...) how many legs there are.
        """
        goals = torch.where(is_task[..., None], goals, self.home(drones)[..., None, :])
        order = torch.arange(goals.shape[-2], device=goals.device)
        ranks = sinusoids(order, self.width, 100.0).expand_as(goals)
        legs = self.leg(torch.cat([goals, drones[..., None, :].expand_as(goals), ranks], dim=-1))
        present = (order < num_legs[..., None])[..., None].to(legs.dtype)
        mean = (legs * present).sum(dim=-2) / present.sum(dim=-2).clamp(min=1.0)
        return legs, drones + mean
