"""The central critic: V(S, h) from the whole fleet's state and all bundle memories. Used in training only."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.teacher.actors.layers import ObservationNormaliser, masked_mean, mlp
from learned.teacher.descriptors import DRONE_FEATURES, PAIR_FEATURES, Observation

__all__ = ["CentralCritic"]


class CentralCritic(nn.Module):
    """Expected return of the team.

    A graph network over drones and tasks along the edges that matter most: each drone hears of its cheapest task, each
    task of its nearest drone, and both of the whole fleet. An estimate per open task of what serving it will cost adds
    up to minus the value, which so fits fleets of every size.

    Args:
        width: Of embeddings.
        memory_width: Of the actor's memories; 0 where it has none.
    """

    def __init__(self, width: int = 64, memory_width: int = 64) -> None:
        super().__init__()
        self.normaliser = ObservationNormaliser()
        self.drone = mlp(len(DRONE_FEATURES) + len(PAIR_FEATURES) + memory_width, width, width)
        self.task = mlp(len(PAIR_FEATURES) + 2 * width, width, width)
        self.price = mlp(2 * width, width, 1)

    def forward(self, observed: Observation, memory: Tensor, num_to_serve: Tensor) -> Tensor:
        """(B,) values.

        Args:
            observed: What all drones see.
            memory: (B, N, W) their bundle memories.
            num_to_serve: (B,) what rewards are divided by.
        """
        pair, drone, _ = self.normaliser(observed)
        cost = pair[..., 0].masked_fill(~observed.allowed[..., :-1], torch.inf)
        cheapest, nearest = cost.argmin(dim=2), cost.argmin(dim=1)  # (B, N), (B, K)
        features = pair.shape[3]
        best = pair.gather(2, cheapest[..., None, None].expand(-1, -1, 1, features))[:, :, 0]  # (B, N, F)
        drones = self.drone(torch.cat([drone, best, memory], dim=2)).relu()  # (B, N, W)
        fleet = masked_mean(drones, observed.drone_mask, dim=1)[:, None].expand(-1, pair.shape[2], -1)
        edge = pair.gather(1, nearest[:, None, :, None].expand(-1, 1, -1, features))[:, 0]  # (B, K, F)
        bearer = drones.gather(1, nearest[..., None].expand(-1, -1, drones.shape[2]))  # (B, K, W)
        tasks = self.task(torch.cat([edge, bearer, fleet], dim=2)).relu()
        everything = masked_mean(tasks, observed.is_open, dim=1)[:, None].expand_as(tasks)
        price = nn.functional.softplus(self.price(torch.cat([tasks, everything], dim=2))[..., 0])  # (B, K)
        return -(price * observed.is_open).sum(dim=1) / num_to_serve
