"""Trajectories from a trained student: the network draws the legs whose straight line is blocked, and only those.

Several tries from different noise cost little; of each leg the shortest try that is clear is kept, or the first where
none is. "Clear" is before any mending: the polyline through the samples keeps what the scene asks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flockopt.geometry import FloatArray
from flockopt.trajectory.waypoints import anchored_legs, leg_clear
from learned.student.batch import FleetBatch, collate
from learned.student.denoiser import Conditions
from learned.student.examples import Example
from learned.student.model import Student

__all__ = ["Drawing", "draw", "task_probabilities"]


@dataclass(frozen=True)
class Drawing:
    """A fleet's trajectories as the student draws them.

    Attributes:
        samples: (N, T, 3) m.
        clear: (N,) whether the drone's polyline through samples and anchors is clear.
        num_drawn: Drones that the network was asked about.
    """

    samples: FloatArray
    clear: NDArray[np.bool_]
    num_drawn: int


@torch.inference_mode()
def task_probabilities(student: Student, batch: FleetBatch) -> list[FloatArray]:
    """For each scene of a batch (N, M) probabilities, p_ij in the paper; NaN where the network fails."""
    probabilities = student.allocate(batch).exp().double().numpy()
    counts = zip(batch.drone_mask.sum(dim=1).tolist(), batch.task_mask.sum(dim=1).tolist(), strict=True)
    return [probabilities[index, :m, :n].T for index, (n, m) in enumerate(counts)]


@torch.inference_mode()
def draw(student: Student, examples: Sequence[Example], *, steps: int = 2, tries: int = 4, seed: int = 0) -> list[Drawing]:
    """Trajectories of the fleets of a batch of scenes with bundles.

    Args:
        student: In evaluation mode.
        examples: Made for the student's number of samples.
        steps: Of DDIM.
        tries: How many are drawn for each leg (each fleet, with fleet attention) to choose from.
        seed: Of the noise.
    """
    batch = collate(examples)
    apart = not student.settings.fleet_attention
    wanted = batch.ways.active & batch.ways.blocked.any(dim=-1) if apart else batch.ways.active
    if not bool(wanted.any()):
        return [_chosen(one, {}) for one in examples]
    ways, conditions = student.condition(batch, wanted if apart else None)
    noise = torch.randn(tries, *ways.straight.shape, generator=torch.Generator().manual_seed(seed))
    many = dataclasses.replace(ways, **_repeated(ways, tries))
    points = student.sample(many, _repeated_conditions(conditions, tries), noise.flatten(0, 1), steps)
    points = points.view(tries, *ways.straight.shape).double().numpy()  # (tries, B or R, N or 1, T, 3)
    drawn: list[dict[int, FloatArray]] = [{} for _ in examples]
    for row, (index, drone) in enumerate(wanted.nonzero().tolist()):
        drawn[index][drone] = points[:, row, 0] if apart else points[:, index, drone]
    return [_chosen(one, tries_of) for one, tries_of in zip(examples, drawn, strict=True)]


def _repeated(record: object, tries: int) -> dict[str, Tensor]:
    tensors = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}  # type: ignore[arg-type]
    return {name: value.repeat(tries, *[1] * (value.dim() - 1)) for name, value in tensors.items() if isinstance(value, Tensor)}


def _repeated_conditions(conditions: Conditions, tries: int) -> Conditions:
    return dataclasses.replace(conditions, **_repeated(conditions, tries))


def _chosen(one: Example, tries_of: dict[int, FloatArray]) -> Drawing:
    """The best of the tries (tries, T, 3) of each drone; the straight way of drones without."""
    samples, clear = one.straight.copy(), ~one.blocked.any(axis=1)
    for drone, tries in tries_of.items():
        finite = tries[np.isfinite(tries).all(axis=(1, 2))]
        if len(finite):
            samples[drone], clear[drone] = _best_try(one, drone, finite)
    return Drawing(samples, clear, len(tries_of))


def _best_try(one: Example, drone: int, tries: FloatArray) -> tuple[FloatArray, bool]:
    """The best samples (T, 3) of some finite tries (tries, T, 3), leg by leg where they share their anchors."""
    if not _shares_anchors(one, drone, tries):
        ranked = [_rank(one, drone, anchored_legs(one.scene, drone, one.routes[drone], samples)) for samples in tries]
        best = min(range(len(tries)), key=ranked.__getitem__)
        return tries[best], not ranked[best][0]
    result, all_clear = one.straight[drone].copy(), True
    for leg in np.unique(one.leg_index[drone][one.blocked[drone]]):
        at = np.flatnonzero(one.leg_index[drone] == leg)[-1]
        first, last = one.leg_begin[drone, at], one.leg_end[drone, at]
        ends = result[[first, last]]
        legs = [np.vstack([ends[:1], samples[first + 1 : last], ends[1:]]) for samples in tries]
        ranked = [_rank(one, drone, [way]) for way in legs]
        best = min(range(len(tries)), key=ranked.__getitem__)
        result[first : last + 1] = legs[best]
        all_clear &= not ranked[best][0]
    return result, all_clear


def _shares_anchors(one: Example, drone: int, tries: FloatArray) -> bool:
    places = np.unique(np.concatenate([one.leg_begin[drone], one.leg_end[drone]]))
    return bool(np.allclose(tries[:, places], one.straight[drone, places], atol=1e-3))


def _rank(one: Example, drone: int, legs: Sequence[FloatArray]) -> tuple[bool, float]:
    """Whether some of the legs (V, 3) is blocked, and their length where none is: less is better."""
    if not all(leg_clear(one.scene, drone, leg) for leg in legs):
        return True, 0.0
    return False, float(sum(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum() for leg in legs))
