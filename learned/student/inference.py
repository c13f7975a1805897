"""Trajectories from a trained student: the network draws the legs whose straight line is blocked, and only those.

Where the first try is not clear, others are made from different noise; of each leg the shortest that is clear is kept,
or the first where none is. "Clear" is before any mending: the polyline through the samples, thinned as the decoder thins
it, keeps what the scene asks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from flockopt.geometry import FloatArray
from flockopt.trajectory.waypoints import CHORD_TOLERANCE, anchored_legs, leg_clear, thinned
from learned.student.batch import FleetBatch, collate
from learned.student.examples import Example
from learned.student.model import Student

__all__ = ["Drawing", "draw", "task_probabilities"]


@dataclass(frozen=True)
class Drawing:
    """A fleet's trajectories as the student draws them.

    Attributes:
        samples: (N, T, 3) m.
        clear: (N,) whether the drone's polyline through samples and anchors is clear, thinned as the decoder thins it.
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
        tries: How many are drawn to choose from: the first for all, the others for drones that are not clear yet, if each
            drone is drawn on its own.
        seed: Of the noise.
    """
    batch = collate(examples)
    apart = not student.settings.fleet_attention
    wanted = (batch.ways.active & batch.ways.blocked.any(dim=-1) if apart else batch.ways.active).nonzero()  # (R, 2)
    generator = torch.Generator().manual_seed(seed)
    drawn: list[dict[int, FloatArray]] = [{} for _ in examples]
    drawings = [_chosen(one, {}) for one in examples]
    # With fleet attention a drone's second try would be of another fleet: all are made at once.
    for count in (1, tries - 1) if apart else (tries,):
        if not count or not len(wanted):
            break
        noise = torch.randn(count, len(wanted), *batch.ways.straight.shape[2:], generator=generator)
        points = student.draw(batch, *wanted.unbind(dim=1), noise, steps).double().numpy()  # (count, R, T, 3)
        for row, (index, drone) in enumerate(wanted.tolist()):
            drawn[index][drone] = np.concatenate([drawn[index].get(drone, points[:0, row]), points[:, row]])
        drawings = [_chosen(one, tries_of) for one, tries_of in zip(examples, drawn, strict=True)]
        wanted = torch.tensor([place for place in wanted.tolist() if not drawings[place[0]].clear[place[1]]])
    return drawings


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
    tolerance = CHORD_TOLERANCE * one.scene.drones[drone].radius
    if not all(leg_clear(one.scene, drone, thinned(leg, tolerance)) for leg in legs):
        return True, 0.0
    return False, float(sum(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum() for leg in legs))
