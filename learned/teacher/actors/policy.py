"""The teacher's actor: a task MLP, an agent context, a GRU that remembers the bundle, and compatibility scores.

Paper, section "Autoregressive CTDE PPO Teacher": e_j = phi_task(f_j), h_i = GRU(h_i, [z_i, e_a]), l_ij = psi(z_i, h_i, e_j).
Each drone decides from its own observation and memory alone; all share the weights. No layer knows how many drones or
tasks there are.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.teacher.actors.layers import ObservationNormaliser, attended, mlp
from learned.teacher.descriptors import DRONE_FEATURES, PAIR_FEATURES, Observation

__all__ = ["TeacherActor"]


class TeacherActor(nn.Module):
    """Scores of tasks and of idling, for every drone.

    Args:
        width: Of embeddings and memory.
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.memory_width = width
        task_width = width // 2
        self.normaliser = ObservationNormaliser()
        self.task_mlp = mlp(len(PAIR_FEATURES), task_width, task_width)
        self.attention = nn.Linear(task_width, 1)
        self.context = mlp(len(DRONE_FEATURES) + task_width, width, width)
        self.non_task = nn.Parameter(torch.zeros(task_width))  # what the memory is told instead of a task
        self.idle = nn.Parameter(torch.zeros(task_width))  # the embedding that idling is scored by
        self.bundle_memory = nn.GRUCell(width + task_width, width)
        self.from_drone = nn.Linear(2 * width, task_width)
        self.from_task = nn.Linear(task_width, task_width, bias=False)
        self.score = nn.Linear(task_width, 1)
        nn.init.normal_(self.score.weight, std=0.01)

    def forward(self, observed: Observation, memory: Tensor) -> tuple[Tensor, Tensor]:
        """One decision of every drone.

        Args:
            observed: What the drones see.
            memory: (B, N, W) bundle memories after the step before; zero at the beginning.

        Returns:
            Scores (B, N, K + 1), idling last, not masked; memories (B, N, W).
        """
        pair, drone, last = self.normaliser(observed)
        tasks = self.task_mlp(pair).relu()  # (B, N, K, E)
        summary = attended(tasks, self.attention(tasks)[..., 0], observed.allowed[..., :-1])  # (B, N, E)
        context = self.context(torch.cat([drone, summary], dim=2)).relu()  # (B, N, W)
        taken = torch.where(observed.has_taken[..., None], self.task_mlp(last).relu(), self.non_task)
        news = torch.cat([context, taken], dim=2)
        memory = self.bundle_memory(news.flatten(0, 1), memory.flatten(0, 1)).view_as(memory)
        own = self.from_drone(torch.cat([context, memory], dim=2))  # (B, N, E)
        scores = self.score((own[:, :, None] + self.from_task(tasks)).relu())[..., 0]  # (B, N, K)
        idle = self.score((own + self.from_task(self.idle)).relu())  # (B, N, 1)
        return torch.cat([scores, idle], dim=2), memory
