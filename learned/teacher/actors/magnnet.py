"""MAGNNET's actor: a graph network over drones and tasks, asked for one task a drone and episode.

After Ratnabala et al., "MAGNNET: multi-agent graph neural network-based efficient task allocation for autonomous vehicles
with deep reinforcement learning" (2025): message passing on the bipartite graph of agents and tasks, whose edges carry
travel, then a choice of a task or idling, trained by PPO with a central critic. It has no memory.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.teacher.actors.layers import ObservationNormaliser, attended, masked_mean
from learned.teacher.descriptors import DRONE_FEATURES, PAIR_FEATURES, Observation

__all__ = ["MagnnetActor"]


class EdgeMessageRound(nn.Module):
    """One round of messages along the edges between drones and tasks, in both directions."""

    def __init__(self, width: int, edge_width: int) -> None:
        super().__init__()
        self.along = nn.Linear(edge_width, edge_width)
        self.from_drone = nn.Linear(width, edge_width, bias=False)
        self.from_task = nn.Linear(width, edge_width, bias=False)
        self.weigh = nn.Linear(edge_width, 2)
        self.update_drone = nn.Linear(2 * width + edge_width, width)
        self.update_task = nn.Linear(width + edge_width, width)

    def forward(
        self, drones: Tensor, tasks: Tensor, edges: Tensor, able: Tensor, drone_mask: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """New embeddings of drones (B, N, W), tasks (B, K, W) and edges (B, N, K, E)."""
        edges = (self.along(edges) + self.from_drone(drones)[:, :, None] + self.from_task(tasks)[:, None]).relu()
        weights = self.weigh(edges)  # (B, N, K, 2)
        fleet = masked_mean(drones, drone_mask, dim=1)[:, None].expand_as(drones)
        heard = attended(edges, weights[..., 0], able)
        drones = self.update_drone(torch.cat([drones, heard, fleet], dim=2)).relu()
        heard = attended(edges.transpose(1, 2), weights[..., 1].transpose(1, 2), able.transpose(1, 2))
        tasks = self.update_task(torch.cat([tasks, heard], dim=2)).relu()
        return drones, tasks, edges


class MagnnetActor(nn.Module):
    """Scores of tasks and of idling, for every drone, from a graph of all of them.

    Args:
        width: Of embeddings.
        num_rounds: Of messages.
    """

    memory_width = 0

    def __init__(self, width: int = 64, num_rounds: int = 2) -> None:
        super().__init__()
        self.normaliser = ObservationNormaliser()
        edge_width = width // 2
        self.edge = nn.Linear(len(PAIR_FEATURES), edge_width)
        self.drone = nn.Linear(len(DRONE_FEATURES), width)
        self.task = nn.Parameter(torch.zeros(width))
        self.rounds = nn.ModuleList(EdgeMessageRound(width, edge_width) for _ in range(num_rounds))
        self.from_drone = nn.Linear(width, edge_width)
        self.from_task = nn.Linear(width, edge_width, bias=False)
        self.from_edge = nn.Linear(edge_width, edge_width, bias=False)
        self.score = nn.Linear(edge_width, 1)
        self.idle = nn.Linear(width, 1)
        nn.init.normal_(self.score.weight, std=0.01)

    def forward(self, observed: Observation, memory: Tensor) -> tuple[Tensor, Tensor]:
        """One decision of every drone; the same interface as `TeacherActor`, whose memory is empty here.

        Args:
            observed: What the drones see.
            memory: (B, N, 0).

        Returns:
            Scores (B, N, K + 1), idling last, not masked; the empty memories.
        """
        pair, drone, _ = self.normaliser(observed)
        able = observed.allowed[..., :-1]
        edges = self.edge(pair).relu()  # (B, N, K, W)
        drones = self.drone(drone).relu()
        tasks = self.task.expand(len(pair), pair.shape[2], -1)
        for messages in self.rounds:
            drones, tasks, edges = messages(drones, tasks, edges, able, observed.drone_mask)
        hidden = self.from_drone(drones)[:, :, None] + self.from_task(tasks)[:, None] + self.from_edge(edges)
        return torch.cat([self.score(hidden.relu())[..., 0], self.idle(drones)], dim=2), memory
