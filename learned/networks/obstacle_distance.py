"""The distance model of `flockopt.geometry.distances` in torch: batched, differentiable, float32."""

from __future__ import annotations

import torch
from torch import Tensor

from flockopt.geometry.distances import BOX, COS_YAW, CYLINDER, HALF_X, HALF_Z, SHAPE, SIN_YAW, X, Z

__all__ = ["outward", "signed_distance", "to_local"]

#: Below this a length is none.
TINY = 1e-6


def to_local(table: Tensor, points: Tensor) -> Tensor:
    """Offsets of points (..., 3) from obstacles (..., 9) along the obstacles' own axes."""
    offset = points - table[..., X : Z + 1]
    cos_yaw, sin_yaw = table[..., COS_YAW], table[..., SIN_YAW]
    x = cos_yaw * offset[..., 0] + sin_yaw * offset[..., 1]
    y = -sin_yaw * offset[..., 0] + cos_yaw * offset[..., 1]
    return torch.stack([x, y, offset[..., 2]], dim=-1)


def signed_distance(table: Tensor, points: Tensor) -> Tensor:
    """Signed distance of points (..., 3) to obstacles (..., 9), negative inside; leading axes broadcast."""
    shape, halves = table[..., SHAPE], table[..., HALF_X : HALF_Z + 1]
    local = to_local(table, points)
    flat = _length(local[..., :2])
    box = _prism(local.abs() - halves)
    cylinder = _prism(torch.stack([flat - halves[..., 0], local[..., 2].abs() - halves[..., 2]], dim=-1))
    sphere = _length(local) - halves[..., 0]
    return torch.where(shape == BOX, box, torch.where(shape == CYLINDER, cylinder, sphere))


def outward(table: Tensor, points: Tensor) -> Tensor:
    """The gradient of `signed_distance` with respect to the points, (..., 3): away from the nearest surface."""
    shape, halves = table[..., SHAPE], table[..., HALF_X : HALF_Z + 1]
    local = to_local(table, points)
    flat = _length(local[..., :2])
    sign = torch.where(local >= 0.0, 1.0, -1.0)
    box = _prism_gradient(local.abs() - halves) * sign
    radial = _prism_gradient(torch.stack([flat - halves[..., 0], local[..., 2].abs() - halves[..., 2]], dim=-1))
    around = radial[..., :1] * local[..., :2] / flat[..., None]
    cylinder = torch.cat([around, radial[..., 1:] * sign[..., 2:]], dim=-1)
    sphere = local / _length(local)[..., None]
    kind = shape[..., None]
    gradient = torch.where(kind == BOX, box, torch.where(kind == CYLINDER, cylinder, sphere))
    cos_yaw, sin_yaw = table[..., COS_YAW], table[..., SIN_YAW]
    x = cos_yaw * gradient[..., 0] - sin_yaw * gradient[..., 1]
    y = sin_yaw * gradient[..., 0] + cos_yaw * gradient[..., 1]
    return torch.stack([x, y, gradient[..., 2]], dim=-1)


def _length(vectors: Tensor) -> Tensor:
    """Euclidean lengths, with a gradient at zero too."""
    return (vectors.square().sum(dim=-1) + TINY**2).sqrt()


def _prism(excess: Tensor) -> Tensor:
    """Signed distance from the excess over each half extent, (..., 2 or 3)."""
    return _length(excess.clamp(min=0.0)) + excess.amax(dim=-1).clamp(max=0.0)


def _prism_gradient(excess: Tensor) -> Tensor:
    """The gradient of `_prism`: outside the unit vector of the positive excess, inside that of the nearest face."""
    outside = excess.clamp(min=0.0)
    deepest = (excess == excess.amax(dim=-1, keepdim=True)).to(excess.dtype)
    inside = (excess.amax(dim=-1, keepdim=True) <= 0.0).to(excess.dtype)
    return (1.0 - inside) * outside / _length(outside)[..., None] + inside * deepest
