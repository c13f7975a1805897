"""The bundle encoder: condition tokens c^B of every drone from its ordered bundle and the scene tokens."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from learned.student.batch import NOTHING, FleetBatch
from learned.student.scene_encoder import SceneTokens

__all__ = ["BundleEncoder", "sinusoids"]


def sinusoids(values: Tensor, width: int, longest: float = 10_000.0) -> Tensor:
    """(..., width): sines and cosines of values at wavelengths up to ``longest`` (Vaswani et al. 2017)."""
    rates = torch.exp(-math.log(longest) * torch.arange(width // 2, device=values.device) / (width // 2))
    angles = values[..., None].float() * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


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
        homes = self.home(tokens.drones)[:, :, None]  # (B, N, 1, D)
        goals = torch.cat([torch.where(there[..., None], goals, homes), homes], dim=2)
        owners = tokens.drones[:, :, None].expand_as(goals)
        ranks = sinusoids(torch.arange(bundle_size + 1, device=goals.device), self.width, 100.0).expand_as(goals)
        legs = self.leg(torch.cat([goals, owners, ranks], dim=-1))
        order = torch.arange(bundle_size + 1, device=goals.device)
        last = there.sum(dim=2, keepdim=True) - (~batch.has_end[..., None]).long()  # (B, N, 1)
        present = (order <= last)[..., None].to(legs.dtype)
        mean = (legs * present).sum(dim=2) / present.sum(dim=2).clamp(min=1.0)
        return legs, tokens.drones + mean
