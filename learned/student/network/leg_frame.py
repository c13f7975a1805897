"""Each leg's own frame, and what a sample of the straight way is told of its surroundings in it."""

from __future__ import annotations

import torch
from torch import Tensor

from flockopt.geometry.distances import BOX, CYLINDER, SPHERE
from learned.networks.obstacle_distance import outward, signed_distance
from learned.student.network.scene_encoder import double_yaw
from learned.student.scenes.batch import WayBatch

__all__ = ["leg_frames", "num_sample_features", "sample_features", "to_points", "to_residuals", "units_m"]

#: Residuals and surroundings are measured in this many times the distance a drone keeps from obstacles.
NEEDS_PER_UNIT = 10.0

#: The least unit, metres, where no distance is to be kept.
LEAST_UNIT_M = 0.1

#: Features of a sample itself, and for each of its nearest obstacles.
NUM_OWN, NUM_PER_OBSTACLE = 13, 15

#: Features are cut off here, units: what is farther away does not matter.
REACH = 4.0


def units_m(ways: WayBatch) -> Tensor:
    """(B, N, 1, 1) m, the unit of each drone's residuals."""
    return (NEEDS_PER_UNIT * ways.needs).clamp(min=LEAST_UNIT_M)[..., None, None]


def _at(points: Tensor, places: Tensor) -> Tensor:
    """Points (B, N, T, 3) at the samples ``places`` (B, N, T)."""
    return points.gather(2, places[..., None].expand_as(points))


def leg_frames(ways: WayBatch) -> Tensor:
    """(B, N, T, 3, 3): rows are the axes along the leg, level across it, and up from both."""
    along = _at(ways.straight, ways.leg_end) - _at(ways.straight, ways.leg_begin)
    along = along / along.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    # level by construction, so that turning the scene about z turns the frames with it; an upright leg has no such direction
    level = torch.stack([-along[..., 1], along[..., 0], torch.zeros_like(along[..., 0])], dim=-1)
    size = level.norm(dim=-1, keepdim=True)
    sideways = torch.tensor([0.0, 1.0, 0.0], device=along.device).expand_as(level)
    across = torch.where(size > 1e-4, level / size.clamp(min=1e-6), sideways)
    return torch.stack([along, across, torch.linalg.cross(along, across)], dim=-2)


def to_residuals(ways: WayBatch, frames: Tensor, points: Tensor) -> Tensor:
    """Points (B, N, T, 3) m as offsets from the straight way, in the legs' frames and the drones' units."""
    return (frames @ (points - ways.straight)[..., None])[..., 0] / units_m(ways)


def to_points(ways: WayBatch, frames: Tensor, residuals: Tensor) -> Tensor:
    """The inverse of `to_residuals`; anchors stay exactly where they are, metres."""
    num_samples = residuals.shape[2]
    sample = torch.arange(num_samples, device=residuals.device)
    between = (sample > ways.leg_begin) & (sample < ways.leg_end)
    offsets = (residuals[..., None, :] @ frames)[..., 0, :] * units_m(ways)
    return ways.straight + offsets * between[..., None]


def num_sample_features(nearest: int) -> int:
    """How many features `sample_features` gives."""
    return NUM_OWN + nearest * NUM_PER_OBSTACLE


def sample_features(ways: WayBatch, frames: Tensor, nearest: int) -> Tensor:
    """(B, N, T, F): where on its leg a sample of the straight way lies, the room to the bounds, the nearest obstacles."""
    unit = units_m(ways)
    sample = torch.arange(ways.straight.shape[2], device=frames.device)
    samples_of_leg = (ways.leg_end - ways.leg_begin).clamp(min=1)
    phase = ((sample - ways.leg_begin) / samples_of_leg)[..., None]
    length = (_at(ways.straight, ways.leg_end) - _at(ways.straight, ways.leg_begin)).norm(dim=-1, keepdim=True) / unit
    below = ((ways.straight - ways.lower[:, None, None]) / unit).clamp(max=REACH)
    above = ((ways.upper[:, None, None] - ways.straight) / unit).clamp(max=REACH)
    own = [phase, phase * (1.0 - phase), length.log1p(), ways.blocked[..., None].float(), frames[..., 0, :], below, above]
    parts = [torch.cat(own, dim=-1)]
    if nearest:
        parts.append(_obstacle_features(ways, frames, unit, nearest))
    return torch.cat(parts, dim=-1)


def _obstacle_features(ways: WayBatch, frames: Tensor, unit: Tensor, nearest: int) -> Tensor:
    """(B, N, T, nearest * 15): room, way out, centre, half extents, kind and turn of the nearest obstacles, nearest first.

    Where there are fewer obstacles, and for those out of reach, all features but the room are zero.
    """
    table, points = ways.obstacles[:, None, None], ways.straight[..., None, :]  # (B, 1, 1, K, 9), (B, N, T, 1, 3)
    missing = nearest - table.shape[-2]
    if missing > 0:
        far = torch.full((*table.shape[:-2], missing, table.shape[-1]), 1e6, device=table.device)
        table = torch.cat([table, far], dim=-2)
    gaps = signed_distance(table, points)  # (B, N, T, K)
    gaps, index = gaps.topk(nearest, dim=-1, largest=False)
    rows = table.expand(*points.shape[:3], -1, -1).gather(3, index[..., None].expand(*index.shape, table.shape[-1]))
    room = ((gaps - ways.needs[..., None, None]) / unit).clamp(max=REACH)[..., None]
    vectors = torch.stack([outward(rows, points), (rows[..., 1:4] - points) / unit[..., None]], dim=-2)
    way_out, centre = (vectors @ frames[..., None, :, :].transpose(-1, -2)).unbind(dim=-2)
    halves = (rows[..., 4:7] / unit[..., None]).clamp(max=REACH)
    kinds = torch.stack([rows[..., 0] == kind for kind in (BOX, CYLINDER, SPHERE)], dim=-1).to(rows.dtype)
    turn = _relative_turn(rows, frames)
    features = torch.cat([way_out, centre.clamp(-REACH, REACH), halves, kinds, turn], dim=-1)
    features = torch.where(room < REACH, features, torch.zeros_like(features))
    return torch.cat([room, features], dim=-1).flatten(3)


def _relative_turn(rows: Tensor, frames: Tensor) -> Tensor:
    """(..., 2): cosine and sine of twice an obstacle's yaw as seen from the leg; zero for round shapes."""
    own = double_yaw(rows)
    # differences of angles by the addition theorems, on doubled angles, which half a turn of a box leaves alone
    heading = frames[..., 1, [1, 0]] * torch.tensor([1.0, -1.0], device=rows.device)  # level direction of the leg
    cos_leg, sin_leg = heading[..., None, 0], heading[..., None, 1]
    cos_two, sin_two = cos_leg**2 - sin_leg**2, 2.0 * cos_leg * sin_leg
    turn = torch.stack([own[..., 0] * cos_two + own[..., 1] * sin_two, own[..., 1] * cos_two - own[..., 0] * sin_two], dim=-1)
    return turn * (rows[..., :1] == BOX)
