"""How fast a training run learns, and in which precision it multiplies."""

from __future__ import annotations

import math

import torch

__all__ = ["is_bfloat16", "rate_at"]

#: The learning rate ends at this share of its highest.
LAST_RATE = 0.02


def rate_at(step: int, steps: int, warmup_steps: int) -> float:
    """The learning rate's share of its highest: it rises, then falls along a cosine."""
    if step < warmup_steps:
        return (step + 1) / warmup_steps
    share = (step - warmup_steps) / max(steps - warmup_steps, 1)
    return LAST_RATE + (1.0 - LAST_RATE) * 0.5 * (1.0 + math.cos(math.pi * share))


def is_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether a run multiplies in bfloat16; ``auto`` does where the hardware has it."""
    if precision != "auto":
        return precision == "bfloat16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())
