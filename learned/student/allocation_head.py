"""Allocation heads: for every task a distribution over drones, p_ij in the paper."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.student.batch import FleetBatch
from learned.student.scene_encoder import SceneTokens

__all__ = ["AttentionHead", "ProductHead"]

#: Layers of the attention head.
NUM_LAYERS = 3


class ProductHead(nn.Module):
    """The paper's: scaled products of task and drone tokens, softmax over drones."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)

    def forward(self, batch: FleetBatch, tokens: SceneTokens) -> Tensor:
        """(B, M, N) log-probabilities; of padded drones minus infinity."""
        scores = self.query(tokens.tasks) @ self.key(tokens.drones).transpose(1, 2) / self.query.out_features**0.5
        return scores.masked_fill(~batch.drone_mask[:, None], -torch.inf).log_softmax(dim=-1)


class AttentionHead(nn.Module):
    """Attention over drones and tasks whose scores fall with the distance between them, learned per layer and head."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(DistanceLayer(width, heads) for _ in range(NUM_LAYERS))
        self.product = ProductHead(width)
        self.nearness = nn.Parameter(torch.zeros(2))

    def forward(self, batch: FleetBatch, tokens: SceneTokens) -> Tensor:
        """(B, M, N) log-probabilities; of padded drones minus infinity."""
        num_drones = tokens.drones.shape[1]
        nodes = torch.cat([tokens.drones, tokens.tasks], dim=1)  # (B, N + M, D)
        places = batch.ways.scaled(torch.cat([batch.starts, batch.tasks], dim=1))
        mask = torch.cat([batch.drone_mask, batch.task_mask], dim=1)
        apart = pair_features(places, batch.drone_mask)  # (B, N + M, N + M, 2)
        for layer in self.layers:
            nodes = layer(nodes, apart, mask)
        refined = SceneTokens(nodes[:, :num_drones], nodes[:, num_drones:], tokens.obstacles, tokens.mask)
        bias = apart[:, num_drones:, :num_drones] @ self.nearness  # (B, M, N)
        return (self.product(batch, refined) - bias).log_softmax(dim=-1)


def pair_features(places: Tensor, drone_mask: Tensor) -> Tensor:
    """(B, U, U, 2): distances between places (B, U, 3) by how densely the drones stand, and their logarithms."""
    squares = (places[:, :, None] - places[:, None]).square().sum(dim=-1)
    spacing = drone_mask.sum(dim=1).to(places.dtype).clamp(min=1.0).rsqrt()[:, None, None]
    distance = (squares + 1e-8).sqrt() / spacing
    return torch.stack([distance, (distance + 0.05).log()], dim=-1)


class DistanceLayer(nn.Module):
    """A pre-norm transformer layer with a bias from `pair_features` on its attention."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.bias = nn.Linear(2, heads)
        self.out = nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, nodes: Tensor, apart: Tensor, mask: Tensor) -> Tensor:
        """Nodes (B, U, D) after the layer; ``apart`` (B, U, U, 2), ``mask`` (B, U)."""
        batch, count, width = nodes.shape
        query, key, value = self.qkv(self.norm(nodes)).view(batch, count, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        bias = self.bias(apart).permute(0, 3, 1, 2).masked_fill(~mask[:, None, None], -1e9)  # (B, heads, U, U)
        mixed = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        nodes = nodes + self.out(mixed.transpose(1, 2).reshape(batch, count, width))
        return nodes + self.mlp(nodes)
