"""Allocation heads: for every task a distribution over drones, p_ij in the paper."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.networks.transformer import stack
from learned.student.scenes.batch import FleetBatch

__all__ = ["AttentionHead", "ProductHead"]

#: Layers of the attention head.
NUM_LAYERS = 3


class ProductHead(nn.Module):
    """The paper's: scaled products of task and drone tokens, softmax over drones."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)

    def forward(self, batch: FleetBatch, drones: Tensor, tasks: Tensor) -> Tensor:
        """(B, M, N) log-probabilities from tokens (B, N, D), (B, M, D); of padded drones minus infinity."""
        scores = self.query(tasks) @ self.key(drones).transpose(1, 2) / self.query.out_features**0.5
        return (scores + batch.drone_mask[:, None].to(scores.dtype).log()).log_softmax(dim=-1)


class AttentionHead(nn.Module):
    """Attention over drones and tasks whose scores fall with the distance between them, learned per layer and head."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.layers = stack(DistanceLayer(width, heads) for _ in range(NUM_LAYERS))
        self.product = ProductHead(width)
        self.nearness = nn.Parameter(torch.zeros(2))

    def forward(self, batch: FleetBatch, drones: Tensor, tasks: Tensor) -> Tensor:
        """(B, M, N) log-probabilities from tokens (B, N, D), (B, M, D); of padded drones minus infinity."""
        num_drones = drones.shape[1]
        nodes = torch.cat([drones, tasks], dim=1)  # (B, N + M, D)
        places = batch.ways.scaled(torch.cat([batch.starts, batch.tasks], dim=1))
        mask = torch.cat([batch.drone_mask, batch.task_mask], dim=1)
        apart = pair_features(places, batch.drone_mask)  # (B, 2, N + M, N + M)
        for layer, bias in zip(self.layers, self._biases(apart, mask), strict=True):
            nodes = layer(nodes, bias)
        distance, log_distance = apart[:, :, num_drones:, :num_drones].unbind(dim=1)  # (B, M, N)
        bias = distance * self.nearness[0] + log_distance * self.nearness[1]
        return (self.product(batch, nodes[:, :num_drones], nodes[:, num_drones:]) - bias).log_softmax(dim=-1)

    def _biases(self, apart: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
        """For each layer (B, heads, U, U), what the attention's scores gain by `pair_features` (B, 2, U, U)."""
        # one product for all layers: distances do not change from layer to layer (as in ALiBi, Press et al. 2022)
        weight = torch.cat([layer.bias.weight for layer in self.layers])  # (layers * heads, 2)
        shift = torch.cat([layer.bias.bias for layer in self.layers])[:, None, None]
        biases = (weight @ apart.flatten(2)).unflatten(2, apart.shape[2:])
        hidden = -1e9 * (~mask[:, None, None]).to(biases.dtype)  # (B, 1, 1, U)
        return (biases + (shift + hidden)).chunk(len(self.layers), dim=1)


def pair_features(places: Tensor, drone_mask: Tensor) -> Tensor:
    """(B, 2, U, U): distances between places (B, U, 3) by how densely the drones stand, and their logarithms."""
    squares = (places[:, :, None] - places[:, None]).square().sum(dim=-1)
    spacing = drone_mask.sum(dim=1).to(places.dtype).clamp(min=1.0).rsqrt()[:, None, None]
    distance = (squares + 1e-8).sqrt() / spacing
    return torch.stack([distance, (distance + 0.05).log()], dim=1)


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

    def forward(self, nodes: Tensor, bias: Tensor) -> Tensor:
        """Nodes (B, U, D) after the layer; ``bias`` (B, heads, U, U) is added to the attention's scores."""
        batch, count, width = nodes.shape
        query, key, value = self.qkv(self.norm(nodes)).view(batch, count, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        mixed = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        nodes = nodes + self.out(mixed.transpose(1, 2).reshape(batch, count, width))
        return nodes + self.mlp(nodes)
