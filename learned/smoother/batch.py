"""Stages of flights as padded tensors in their drones' own units: greatest speed and acceleration are 1, origins the starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flockopt.geometry.distances import distances
from flockopt.records.arrays import FloatArray
from learned.demonstrations.timed_shards import NO_PHASE, StageRecord

__all__ = ["MOST_JOINTS", "StageBatch", "UnitStage", "collate_stages", "unit_stage"]

#: Joints of a stage that the network takes.
MOST_JOINTS = 32

#: Obstacles that a piece is told of: those nearest to its control points.
NEAREST = 4

#: A row of the obstacle table that stands for none: a ball far away.
NOWHERE = (2.0, 1e3, 1e3, 1e3, 0.1, 0.1, 0.1, 1.0, 0.0)

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class UnitStage:
    """One stage in its drone's units; J joints, P = J - 1 pieces, O obstacles a piece."""

    states: Float32  # (J, 3, 3)
    durations: Float32  # (P,)
    phases: Float32  # (P,)
    anchored: NDArray[np.bool_]  # (J,)
    obstacles: Float32  # (P, O, 9)
    bounds: Float32  # (2, 3)
    need: float
    max_jerk: float
    length_m: float  # one unit of length
    teacher_states: Float32  # (J, 3, 3), the given ones without a teacher
    teacher_durations: Float32  # (P,)


def unit_stage(record: StageRecord) -> UnitStage:
    """A record in units of max_speed² / max_acceleration and max_speed / max_acceleration."""
    speed, acceleration, jerk = record.limits
    length, time, origin = speed**2 / acceleration, speed / acceleration, record.states[0, 0]
    teacher_states = record.states if record.teacher_states is None else record.teacher_states
    teacher_durations = record.durations if record.teacher_durations is None else record.teacher_durations
    return UnitStage(
        _scaled(record.states, length, time, origin), (record.durations / time).astype(np.float32),
        record.phases.astype(np.float32), record.anchored, _nearest(record, length), _bounds(record, length),
        float(record.need / length), float(jerk * time / acceleration), float(length),
        _scaled(teacher_states, length, time, origin), (teacher_durations / time).astype(np.float32),
    )  # fmt: skip


def _scaled(states: FloatArray, length: float, time: float, origin: FloatArray) -> Float32:
    shifted = states.astype(np.float64)
    shifted[:, 0] -= origin
    return (shifted / (length * np.array([[1.0], [1.0 / time], [1.0 / time**2]]))).astype(np.float32)


def _bounds(record: StageRecord, length: float) -> Float32:
    return ((record.bounds - record.states[0, 0]) / length).astype(np.float32)


def _nearest(record: StageRecord, length: float) -> Float32:
    """(P, O, 9): of every piece the obstacles nearest to its ends and the points between them."""
    ends = record.states[:, 0].astype(np.float64)
    shares = np.linspace(0.0, 1.0, 5)[:, None]
    points = ends[:-1, None] * (1.0 - shares) + ends[1:, None] * shares  # (P, 5, 3)
    table = record.obstacles.copy()
    result = np.tile(np.array(NOWHERE, dtype=np.float32), (len(points), NEAREST, 1))
    if not len(table):
        return result
    gaps = distances(table, points.reshape(-1, 3)).reshape(*points.shape[:2], -1).min(axis=1)  # (P, K)
    order = np.argsort(gaps, axis=1, kind="stable")[:, :NEAREST]
    table[:, 1:4] -= record.states[0, 0]
    table[:, 1:7] /= length
    result[:, : order.shape[1]] = table[order]
    return result


@dataclass(frozen=True, eq=False)
class StageBatch:
    """Stages padded to equal lengths; a padded piece takes 1 unit of time and leads nowhere.

    Attributes:
        states: (B, J, 3, 3) position, velocity and acceleration.
        durations: (B, P).
        phases: (B, P), `NO_PHASE` where no task is passed inside.
        anchored: (B, J) bool, joints at tasks.
        joints: (B, J) bool, which joints there are.
        obstacles: (B, P, O, 9).
        bounds: (B, 2, 3).
        need: (B,) what the centre is to keep from obstacles.
        max_jerk: (B,).
        length_m: (B,) metres in a unit of length.
        teacher_states: (B, J, 3, 3).
        teacher_durations: (B, P).
    """

    states: Tensor
    durations: Tensor
    phases: Tensor
    anchored: Tensor
    joints: Tensor
    obstacles: Tensor
    bounds: Tensor
    need: Tensor
    max_jerk: Tensor
    length_m: Tensor
    teacher_states: Tensor
    teacher_durations: Tensor

    @property
    def pieces(self) -> Tensor:
        """(B, P) bool, which pieces there are."""
        return self.joints[:, 1:]

    @property
    def inner(self) -> Tensor:
        """(B, J) bool, joints that are no ends of their stage: their states are free."""
        inner = self.joints.clone()
        inner[:, 0] = False
        inner[:, :-1] &= self.joints[:, 1:]
        inner[:, -1] = False
        return inner

    def to(self, device: torch.device) -> StageBatch:
        """The same elsewhere."""
        return StageBatch(**{field.name: getattr(self, field.name).to(device) for field in fields(self)})

    def repeated(self, times: int) -> StageBatch:
        """Every stage ``times`` times in turn."""
        return StageBatch(**{field.name: getattr(self, field.name).repeat_interleave(times, dim=0) for field in fields(self)})

    def mirrored(self) -> StageBatch:
        """All of it in a mirror that stands along x."""
        bounds = self.bounds.clone()
        bounds[:, :, 1] = -self.bounds.flip(1)[:, :, 1]
        flip = torch.tensor([1.0, -1.0, 1.0], device=self.states.device)
        obstacles = self.obstacles.clone()
        obstacles[..., [2, 8]] *= -1.0  # y of the centre, and the sine of the yaw
        states, teacher = self.states * flip, self.teacher_states * flip
        return replace(self, states=states, teacher_states=teacher, obstacles=obstacles, bounds=bounds)


def collate_stages(stages: Sequence[UnitStage]) -> StageBatch:
    """Stages as a batch, as long as the longest of them."""
    most = max(len(stage.states) for stage in stages)
    batch = {
        name: torch.from_numpy(np.stack([_padded(getattr(stage, name), most - short, fill) for stage in stages]))
        for name, short, fill in (
            ("states", 0, 0.0), ("durations", 1, 1.0), ("phases", 1, NO_PHASE), ("anchored", 0, False),
            ("obstacles", 1, NOWHERE), ("teacher_states", 0, 0.0), ("teacher_durations", 1, 1.0),
        )
    }  # fmt: skip
    joints = np.arange(most) < np.array([len(stage.states) for stage in stages])[:, None]
    scalars = {
        name: torch.tensor([getattr(stage, name) for stage in stages], dtype=torch.float32)
        for name in ("need", "max_jerk", "length_m")
    }
    bounds = torch.from_numpy(np.stack([stage.bounds for stage in stages]))
    return StageBatch(joints=torch.from_numpy(joints), bounds=bounds, **batch, **scalars)


def _padded(values: NDArray[np.generic], count: int, fill: float | tuple[float, ...]) -> NDArray[np.generic]:
    """Values with as many rows as there shall be."""
    missing = (count - len(values), *values.shape[1:])
    return np.concatenate([values, np.broadcast_to(np.asarray(fill, dtype=values.dtype), missing)])
