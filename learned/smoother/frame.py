"""What is learned of a stage: how its joints' states and durations change, each in the joint's own frame.

A joint's frame has its x along the way from the joint before to the joint after, seen from above, and z up. A residual is
(dp, dv, da, d log duration of the piece that follows), 10 numbers in the drone's units.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from learned.smoother.batch import StageBatch

__all__ = [
    "RESIDUALS", "at_phase", "bernstein", "control_points", "flat_frames", "following", "free", "into_frames", "out_of_frames",
    "quadratic_products", "residuals", "squared_jerk", "states_of",
]  # fmt: skip

#: Numbers in a residual.
RESIDUALS = 10

#: A duration is changed by this factor at the most, either way; as a logarithm.
MOST_LOG = 0.69

#: Ways from above shorter than this have no direction, units.
NO_WAY = 1e-3


def following(batch: StageBatch, values: Tensor, step: int) -> Tensor:
    """Values (B, J, ...) of the joint ``step`` places on, or of the stage's end."""
    last = batch.joints.sum(dim=1, keepdim=True) - 1
    place = (torch.arange(values.shape[1], device=values.device) + step).clamp(min=0).expand(len(values), -1)
    index = torch.minimum(place, last).view(*place.shape, *[1] * (values.dim() - 2)).expand_as(values)
    return values.gather(1, index)


def flat_frames(batch: StageBatch) -> Tensor:
    """(B, J, 2): cosine and sine of each joint's frame; where the way is upright, of the way from start to end."""
    places = batch.states[:, :, 0]
    way = (following(batch, places, 1) - following(batch, places, -1))[..., :2]
    whole = (following(batch, places, places.shape[1]) - following(batch, places, -places.shape[1]))[..., :2]
    x_axis = torch.tensor([1.0, 0.0], device=way.device)
    way = torch.where(way.norm(dim=-1, keepdim=True) > NO_WAY, way, whole)
    way = torch.where(way.norm(dim=-1, keepdim=True) > NO_WAY, way, x_axis)
    return way / way.norm(dim=-1, keepdim=True)


def into_frames(frames: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (B, J, ..., 3) of the scene in frames (B, J, 2)."""
    return out_of_frames(frames * torch.tensor([1.0, -1.0], device=frames.device), vectors)


def out_of_frames(frames: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (B, J, ..., 3) of frames (B, J, 2) in the scene."""
    shape = (*frames.shape[:2], *[1] * (vectors.dim() - 3))
    cos, sin = frames[..., 0].view(shape), frames[..., 1].view(shape)
    x, y, z = vectors.unbind(dim=-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z], dim=-1)


def residuals(batch: StageBatch, frames: Tensor) -> Tensor:
    """(B, J, 10) from the given stages to the teacher's; 0 where there is nothing to choose."""
    changes = into_frames(frames, batch.teacher_states - batch.states).flatten(2)  # (B, J, 9)
    longer = (batch.teacher_durations / batch.durations).log()
    return torch.cat([changes, torch.nn.functional.pad(longer, (0, 1))[..., None]], dim=-1) * free(batch)


def free(batch: StageBatch) -> Tensor:
    """(B, J, 10): 1 for what there is to choose, 0 for ends, for positions at tasks and for what is not there."""
    inner = batch.inner[..., None].float()
    moving = inner * (~batch.anchored[..., None]).float()
    timed = torch.nn.functional.pad(batch.pieces.float(), (0, 1))[..., None]
    return torch.cat([moving.expand(-1, -1, 3), inner.expand(-1, -1, 6), timed], dim=-1)


def states_of(batch: StageBatch, frames: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
    """States (B, J, 3, 3) and durations (B, P) from residuals (B, J, 10)."""
    changes = changes * free(batch)
    states = batch.states + out_of_frames(frames, changes[..., :9].unflatten(-1, (3, 3)))
    durations = batch.durations * changes[:, :-1, 9].clamp(-MOST_LOG, MOST_LOG).exp()
    return states, durations


def at_phase(states: Tensor, durations: Tensor, phases: Tensor) -> Tensor:
    """(B, P, 3): where the quintics between states are at one phase each."""
    phase = phases.clamp(0.0, 1.0)
    return (control_points(states, durations) * bernstein(phase, 5)[..., None]).sum(dim=2)


def control_points(states: Tensor, durations: Tensor) -> Tensor:
    """(B, P, 6, 3) of the quintics between states (B, J, 3, 3): see `flockopt.flights.smoothing.stages.hermite`."""
    time = durations[..., None]
    # The ends of a Bezier curve of degree 5: its first differences are v time / 5, its second ones a time² / 20.
    (p, v, a), (q, w, b) = (part.unbind(dim=2) for part in (states[:, :-1], states[:, 1:]))
    first = p + 0.2 * time * v
    last = q - 0.2 * time * w
    second = p + 0.4 * time * v + 0.05 * time**2 * a
    fourth = q - 0.4 * time * w + 0.05 * time**2 * b
    return torch.stack([p, first, second, fourth, last, q], dim=2)


def squared_jerk(states: Tensor, durations: Tensor, pieces: Tensor) -> Tensor:
    """(B,): integral of the squared jerk of the quintics between states, over those pieces (B, P) that there are."""
    # 5 * 4 * 3 times third differences are the control points of a quintic's third derivative (Farin 2002, section 5.3);
    # the jerk is that over the duration cubed, squared and integrated over a duration: hence the fifth power.
    third = 60.0 * control_points(states, durations).diff(n=3, dim=2)  # (B, P, 3, 3)
    products = torch.einsum("bpia,bpja->bpij", third, third)
    return ((products * quadratic_products(third)).sum(dim=(2, 3)) / durations**5 * pieces).sum(dim=1)


def quadratic_products(like: Tensor) -> Tensor:
    """(3, 3): integrals over [0, 1] of products of two quadratic Bernstein polynomials, in the kind of another tensor.

    That of the i-th and j-th is C(2, i) C(2, j) / (5 C(4, i + j)).
    """
    return torch.tensor([[6.0, 3.0, 1.0], [3.0, 4.0, 3.0], [1.0, 3.0, 6.0]], device=like.device).to(like) / 30.0


def bernstein(phases: Tensor, degree: int) -> Tensor:
    """(..., degree + 1): the Bernstein polynomials at phases."""
    powers = torch.arange(degree + 1, device=phases.device)
    choose = torch.tensor([float(math.comb(degree, k)) for k in range(degree + 1)], device=phases.device).to(phases)
    return choose * phases[..., None] ** powers * (1.0 - phases[..., None]) ** (degree - powers)
