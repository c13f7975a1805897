"""Small layers that the teacher, MAGNNET and their critics share."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from learned.teacher.descriptors import DRONE_FEATURES, PAIR_FEATURES, Observation

__all__ = ["Normaliser", "ObservationNormaliser", "attended", "masked_mean", "mlp"]

#: Normalised features beyond this are clipped, so that a strange scene cannot drive a network far from what it has seen.
MOST_DEVIATIONS = 5.0


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for width, next_width in pairwise(widths):
        layers += [nn.Linear(width, next_width), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def masked_mean(values: Tensor, mask: Tensor, dim: int) -> Tensor:
    """Mean along an axis over the entries of a mask; 0 where it has none. ``mask`` lacks the last axis of ``values``."""
    weight = mask.to(values.dtype).unsqueeze(-1)
    return (values * weight).sum(dim) / weight.sum(dim).clamp(min=1.0)


def attended(values: Tensor, scores: Tensor, mask: Tensor) -> Tensor:
    """(..., W): mean along the last axis but one, weighted by the softmax of scores over the entries of a mask.

    Args:
        values: (..., A, W).
        scores: (..., A).
        mask: (..., A) bool; where it has no entry at all the mean is 0.
    """
    weights = scores.masked_fill(~mask, -1e4).softmax(dim=-1) * mask
    return (weights[..., None, :] @ values)[..., 0, :]


class Normaliser(nn.Module):
    """Shifts and scales features by what was measured once; the figures are saved with the weights."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, num_features: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(num_features))
        self.register_buffer("deviation", torch.ones(num_features))

    def measure(self, features: Tensor) -> None:
        """Take mean and deviation from (K, F) features."""
        self.mean.copy_(features.mean(dim=0))
        self.deviation.copy_(features.std(dim=0).clamp(min=1e-2))

    def forward(self, features: Tensor) -> Tensor:
        """Normalised features of any leading shape."""
        return ((features - self.mean) / self.deviation).clamp(-MOST_DEVIATIONS, MOST_DEVIATIONS)


class ObservationNormaliser(nn.Module):
    """`Normaliser` for both kinds of features of an `Observation`."""

    def __init__(self) -> None:
        super().__init__()
        self.pair = Normaliser(len(PAIR_FEATURES))
        self.drone = Normaliser(len(DRONE_FEATURES))

    def measure(self, observations: list[Observation]) -> None:
        """Take the figures from the open tasks and real drones of some observations."""
        seen = [observed.drone_mask[:, :, None] & observed.is_open[:, None, :] for observed in observations]
        self.pair.measure(torch.cat([o.pair[mask] for o, mask in zip(observations, seen, strict=True)]))
        self.drone.measure(torch.cat([o.drone[o.drone_mask] for o in observations]))

    def forward(self, observed: Observation) -> tuple[Tensor, Tensor, Tensor]:
        """Normalised features: of pairs, of drones, and of the tasks last taken."""
        return self.pair(observed.pair), self.drone(observed.drone), self.pair(observed.last)
