"""What the network is told of every joint, in the joint's own frame and the drone's units."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from learned.demonstrations.timed_shards import NO_PHASE
from learned.networks.obstacle_distance import outward, signed_distance
from learned.smoother.batch import StageBatch
from learned.smoother.frame import bernstein, control_points, following, into_frames

__all__ = ["NUM_FEATURES", "stage_features"]

#: Phases of the piece that follows at which obstacles are looked at; 0 is the joint itself.
PHASES = (0.0, 1 / 3, 2 / 3)

#: Obstacles at each of them.
NEAREST_AT = 2

#: Motion, frames, durations, kind; obstacles; bounds.
NUM_FEATURES = 20 + 8 + 4 * NEAREST_AT * len(PHASES) + 6


def stage_features(batch: StageBatch, frames: Tensor, extra: Tensor) -> Tensor:
    """(B, J, F) features of joints.

    Args:
        batch: Stages.
        frames: (B, J, 2) of `flat_frames`.
        extra: (B,) how much more than ``need`` is to be kept from obstacles, units.
    """
    need = (batch.need + extra)[:, None, None]
    parts = [*_motion(batch, frames), _kind(batch), _obstacles(batch, frames, need), _room(batch, frames)]
    return torch.cat(parts, dim=-1) * batch.joints[..., None]


def _motion(batch: StageBatch, frames: Tensor) -> list[Tensor]:
    """(B, J, 20): velocity, acceleration, the ways before and after, their frames, log durations, and the time passed."""
    places = batch.states[:, :, 0]
    moves = [into_frames(frames, batch.states[:, :, order]) for order in (1, 2)]
    ways = [torch.asinh(into_frames(frames, following(batch, places, step) - places)) for step in (-1, 1)]
    turns = [into_frames(frames, pad(following(batch, frames, step), (0, 1)))[..., :2] for step in (-1, 1)]
    logs = torch.where(batch.pieces, batch.durations.log(), 0.0)
    durations = torch.stack([pad(logs, (1, 0)), pad(logs, (0, 1))], dim=-1)
    passed = pad((batch.durations * batch.pieces).cumsum(dim=1), (1, 0))
    total = passed[:, -1:]
    time = torch.stack([passed / total, total.log().expand_as(passed)], dim=-1)
    return [*moves, *ways, *turns, durations, time]


def _kind(batch: StageBatch) -> Tensor:
    """(B, J, 8): whether it is free, at a task, before or after a piece that passes one, and at which phase; jerk, need."""
    passes = (batch.phases != NO_PHASE).float()
    phases = batch.phases.clamp(min=0.0)
    wide = batch.max_jerk.log()[:, None].expand_as(batch.joints), batch.need[:, None].expand_as(batch.joints)
    pieces = [pad(values, sides) for values in (passes, phases) for sides in ((1, 0), (0, 1))]
    return torch.stack([batch.inner.float(), batch.anchored.float(), *pieces, *wide], dim=-1)


def _obstacles(batch: StageBatch, frames: Tensor, need: Tensor) -> Tensor:
    """(B, J, 4 O Q): at each phase the room to the nearest obstacles, and the way out of them."""
    control = control_points(batch.states, batch.durations)
    basis = bernstein(torch.tensor(PHASES, device=control.device), 5)  # (Q, 6)
    points = torch.einsum("qi,bpia->bpqa", basis, control)
    tables = batch.obstacles[:, :, None]  # (B, P, 1, O, 9)
    gaps, nearest = (signed_distance(tables, points[..., None, :]) - need[..., None]).topk(NEAREST_AT, largest=False)
    chosen = tables.expand(-1, -1, len(PHASES), -1, -1).gather(3, nearest[..., None].expand(*nearest.shape, 9))
    ways = outward(chosen, points[..., None, :])  # (B, P, Q, 2, 3)
    ways = into_frames(frames[:, :-1], ways)
    told = torch.cat([torch.asinh(4.0 * gaps).clamp(max=3.0)[..., None], ways * (gaps[..., None] < 3.0)], dim=-1)
    return pad(told.flatten(2), (0, 0, 0, 1))


def _room(batch: StageBatch, frames: Tensor) -> Tensor:
    """(B, J, 6): room below and above, to the nearest side of the bounds, and the way from that side."""
    places = batch.states[:, :, 0]
    below = (places - batch.bounds[:, None, 0]).clamp(max=3.0)
    above = (batch.bounds[:, None, 1] - places).clamp(max=3.0)
    sides = torch.cat([below[..., :2], above[..., :2]], dim=-1)  # (B, J, 4)
    least, side = sides.min(dim=-1)
    inward = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]], device=places.device)[side]
    told = into_frames(frames, inward) * (least < 3.0)[..., None]
    return torch.cat([below[..., 2:], above[..., 2:], least[..., None], told], dim=-1)
