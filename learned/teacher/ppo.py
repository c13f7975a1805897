"""The parts of proximal policy optimisation, each a function on tensors: masking, advantages, losses.

Schulman et al., "Proximal policy optimization algorithms" (2017) and "High-dimensional continuous control using
generalized advantage estimation" (2016).
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["clipped_policy_loss", "entropy", "generalised_advantages", "masked_log_softmax", "normalised", "value_loss"]


def masked_log_softmax(scores: Tensor, allowed: Tensor) -> Tensor:
    """Log-probabilities over the last axis; minus infinity, so a probability of exactly 0, where not allowed.

    Args:
        scores: (..., A).
        allowed: (..., A) bool, at least one in each row.
    """
    return torch.log_softmax(scores.masked_fill(~allowed, -torch.inf), dim=-1)


def entropy(log_probs: Tensor) -> Tensor:
    """Entropy over the last axis, in nats; impossible actions add nothing."""
    return -(log_probs.exp() * log_probs.clamp(min=torch.finfo(log_probs.dtype).min)).sum(dim=-1)


def generalised_advantages(
    rewards: Tensor, values: Tensor, is_active: Tensor, *, discount: float, trace: float
) -> tuple[Tensor, Tensor]:
    """Advantages by GAE, and the returns that the critic is to learn.

    Args:
        rewards: (K, B) of each step and episode.
        values: (K, B) the critic's estimates before each step.
        is_active: (K, B) bool, false after an episode's end; what follows the last active step is worth 0.
        discount: gamma.
        trace: lambda.

    Returns:
        (K, B) each, 0 where not active.
    """
    # backwards: A_k = delta_k + gamma lambda A_(k+1), delta_k = r_k + gamma V_(k+1) - V_k (Schulman et al. 2016, equation 16)
    advantages = torch.zeros_like(rewards)
    following, next_value = torch.zeros_like(rewards[0]), torch.zeros_like(rewards[0])
    for k in reversed(range(len(rewards))):
        surprise = rewards[k] + discount * next_value - values[k]
        following = torch.where(is_active[k], surprise + discount * trace * following, 0.0)
        next_value = torch.where(is_active[k], values[k], 0.0)
        advantages[k] = following
    return advantages, torch.where(is_active, advantages + values, 0.0)


def normalised(values: Tensor) -> Tensor:
    """Values shifted and scaled to mean 0 and standard deviation 1; all 0 where they are all equal."""
    centred = values - values.mean()
    return centred / centred.square().mean().sqrt().clamp(min=1e-8)


def clipped_policy_loss(log_probs: Tensor, old_log_probs: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """Minus the clipped surrogate objective, a mean over all entries.

    Args:
        log_probs: Of the actions taken, under the policy that is trained.
        old_log_probs: The same under the policy that acted.
        advantages: Of these actions; broadcast against the others.
        clip: How far the ratio of probabilities may go from 1 and still be rewarded.
    """
    ratio = (log_probs - old_log_probs).exp()
    return -torch.minimum(ratio * advantages, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages).mean()


def value_loss(values: Tensor, returns: Tensor) -> Tensor:
    """Half the mean squared error of the critic."""
    return 0.5 * (values - returns).square().mean()
