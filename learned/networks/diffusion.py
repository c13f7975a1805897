"""The forward process with a cosine schedule, and deterministic DDIM with clean-sample prediction."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor

from flockopt.errors import SettingsError
from flockopt.records import checks

__all__ = ["add_noise", "ddim", "ddim_step", "noise_levels", "signal_levels"]

#: The cosine schedule's offset, and the most noise of one step (Nichol and Dhariwal 2021).
OFFSET, MOST_BETA = 0.008, 0.999


@cache
def signal_levels(num_noise_levels: int) -> Tensor:
    """(S + 1,): the cumulative signal coefficient of each noise level, 1 at level 0."""
    steps = torch.arange(num_noise_levels + 1, dtype=torch.float64) / num_noise_levels
    cosines = torch.cos((steps + OFFSET) / (1 + OFFSET) * math.pi / 2).square()
    # the signal falls as a squared cosine; the last step would leave none of it, and is cut off
    betas = (1.0 - cosines[1:] / cosines[:-1]).clamp(max=MOST_BETA)
    return torch.cat([torch.ones(1, dtype=torch.float64), (1.0 - betas).cumprod(dim=0)]).float()


def add_noise(clean: Tensor, noise: Tensor, noise_level: Tensor, num_noise_levels: int) -> Tensor:
    """X_t in the paper: clean samples (B, ...) with noise of level ``noise_level`` (B,)."""
    signal = signal_levels(num_noise_levels).to(clean.device)[noise_level].view(-1, *[1] * (clean.dim() - 1))
    return signal.sqrt() * clean + (1.0 - signal).sqrt() * noise


def noise_levels(steps: int, num_noise_levels: int) -> list[int]:
    """The levels that DDIM passes, from all noise to none: ``steps + 1`` of them, evenly spaced.

    Raises:
        SettingsError: If the steps are not between 1 and the number of levels.
    """
    checks.integer(SettingsError, "steps", steps, least=1)
    if steps > num_noise_levels:
        raise SettingsError("steps", f"is {steps}", f"must be at most {num_noise_levels}", "take fewer")
    return [round(num_noise_levels * (steps - index) / steps) for index in range(steps + 1)]


def ddim(denoise: Callable[[Tensor, Tensor], Tensor], noise: Tensor, steps: int, num_noise_levels: int) -> Tensor:
    """Clean samples from noise (B, ...), without chance beyond the noise itself (Song et al. 2021, eta = 0).

    Args:
        denoise: From noisy samples and noise levels (B,) to clean samples.
        noise: Standard normal.
        steps: Calls of ``denoise``.
        num_noise_levels: S.
    """
    signal = signal_levels(num_noise_levels).tolist()
    levels = noise_levels(steps, num_noise_levels)
    noisy = noise
    for level, following in pairwise(levels):
        clean = denoise(noisy, torch.full((noise.shape[0],), level, device=noise.device))
        noisy = ddim_step(noisy, clean, signal[level], signal[following])
    return noisy


def ddim_step(noisy: Tensor, clean: Tensor, signal: float, following: float) -> Tensor:
    """From samples with signal coefficient ``signal``, and what was predicted of them, to those with ``following``."""
    # the noise that clean samples imply, put back at its new strength (Song et al. 2021, equation 12 with sigma = 0)
    rest = (noisy - math.sqrt(signal) * clean) / math.sqrt(1.0 - signal)
    return math.sqrt(following) * clean + math.sqrt(1.0 - following) * rest
