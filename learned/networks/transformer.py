"""Parts of transformers that the student and the smoother use."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

__all__ = ["TransformerBlock", "sinusoids", "stack", "zeroed"]


def sinusoids(values: Tensor, width: int, longest: float = 10_000.0) -> Tensor:
    """(..., width): sines and cosines of values at wavelengths up to ``longest`` (Vaswani et al. 2017)."""
    rates = torch.exp(-math.log(longest) * torch.arange(width // 2, device=values.device) / (width // 2))
    angles = values[..., None].float() * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


Layer = TypeVar("Layer", bound=nn.Module)


def stack(layers: Iterable[Layer]) -> Sequence[Layer]:
    """Layers of one kind as an `nn.ModuleList`, which forgets their kind before type checkers."""
    return cast("Sequence[Layer]", nn.ModuleList(layers))


class TransformerBlock(nn.Module):
    """Attention and an MLP, each shifted, scaled and gated by the condition; gates begin at zero."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norms = nn.ModuleList(nn.LayerNorm(width, elementwise_affine=False) for _ in range(2))
        self.modulation = zeroed(nn.Linear(width, 6 * width))
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(approximate="tanh"), nn.Linear(4 * width, width))

    def forward(self, tokens: Tensor, vectors: Tensor, mask: Tensor | None) -> Tensor:
        """Tokens (B, U, D); conditions (B, U or 1, D), already activated; mask (B, 1, 1, U) of what may be heard."""
        return self.modulated(tokens, self.modulation(vectors), mask)

    def modulated(self, tokens: Tensor, modulation: Tensor, mask: Tensor | None) -> Tensor:
        """The same from the conditions' modulation, (B, U or 1, 6 D)."""
        batch, count, width = tokens.shape
        shift, scale, gate, mlp_shift, mlp_scale, mlp_gate = modulation.chunk(6, dim=-1)
        normed = torch.addcmul(shift, self.norms[0](tokens), 1.0 + scale)
        query, key, value = self.qkv(normed).view(batch, count, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        mixed = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        tokens = torch.addcmul(tokens, gate, self.out(mixed.transpose(1, 2).reshape(batch, count, width)))
        return torch.addcmul(tokens, mlp_gate, self.mlp(torch.addcmul(mlp_shift, self.norms[1](tokens), 1.0 + mlp_scale)))


def zeroed(layer: nn.Linear) -> nn.Linear:
    """The layer with weights and bias of zero: what it adds begins as nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
