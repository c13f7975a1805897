"""Trajectories from a trained student: the network draws the legs whose straight line is blocked, and only those.

Where the first try is not clear, others are made from different noise; of each leg the shortest that is clear is kept,
or the first where none is. "Clear" is before any mending: the polyline through the samples, thinned as the decoder thins
it, keeps what the scene asks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flockopt.flights.waypoints import CHORD_TOLERANCE, anchored_legs
from flockopt.records.arrays import FloatArray
from learned.student.legs.choice import best_legs, rank
from learned.student.network.rows import Place, Rows, points_of, rows_of
from learned.student.network.scene_encoder import AgentTokens
from learned.student.scenes.batch import FleetBatch, collate
from learned.student.scenes.examples import Example
from learned.student.settings import StudentSettings

__all__ = ["DrawnFleet", "Network", "decide", "draw", "task_probabilities"]

#: Tries are told apart leg by leg where they pass their anchors within this, metres.
SAME_ANCHOR_M = 1e-3


class Network(Protocol):
    """What is asked of a `learned.student.network.model.Student`, or of one that stands in for it."""

    settings: StudentSettings

    @property
    def draws_rows(self) -> bool:
        """Whether `sample` may be asked; `draw` otherwise."""

    def allocate(self, batch: FleetBatch) -> Tensor:
        """(B, M, N) log-probabilities."""

    def decide(self, batch: FleetBatch) -> tuple[Tensor, AgentTokens]:
        """The same, and the tokens that they come from."""

    def sample(self, rows: Rows, noise: Tensor, steps: int) -> Tensor:
        """Residuals (R, T, 3) of drones each on its own."""

    def draw(self, batch: FleetBatch, scene: Tensor, drone: Tensor, noise: Tensor, steps: int) -> Tensor:
        """(tries, R, T, 3) m, with whole fleets in view."""


@dataclass(frozen=True)
class DrawnFleet:
    """A fleet's trajectories as the student draws them.

    Attributes:
        samples: (N, T, 3) m.
        clear: (N,) whether the drone's polyline through samples and anchors is clear, thinned as the decoder thins it.
        num_drawn: Drones that the network was asked about.
        example: What was drawn on: the scene, the bundles, and where their anchors are among the samples.
    """

    samples: FloatArray
    clear: NDArray[np.bool_]
    num_drawn: int
    example: Example


@torch.inference_mode()
def task_probabilities(student: Network, batch: FleetBatch) -> list[FloatArray]:
    """For each scene of a batch (N, M) probabilities, p_ij in the paper; NaN where the network fails."""
    return _unpadded(batch, student.allocate(batch))


def _unpadded(batch: FleetBatch, log_probs: Tensor) -> list[FloatArray]:
    """Log-probabilities (B, M, N) as probabilities (N, M), scene by scene."""
    probabilities = log_probs.exp().double().numpy()
    counts = zip(batch.drone_mask.sum(dim=1).tolist(), batch.task_mask.sum(dim=1).tolist(), strict=True)
    return [probabilities[index, :m, :n].T for index, (n, m) in enumerate(counts)]


@torch.inference_mode()
def decide(student: Network, batch: FleetBatch) -> tuple[list[FloatArray], AgentTokens]:
    """`task_probabilities`, and the tokens that they come from, which `draw` may go on with."""
    log_probs, tokens = student.decide(batch)
    return _unpadded(batch, log_probs), tokens


@torch.inference_mode()
def draw(
    student: Network, examples: Sequence[Example], *, steps: int | tuple[int, int] = 2, tries: int = 4,
    seed: int | Sequence[int] = 0, tokens: AgentTokens | None = None,
) -> list[DrawnFleet]:  # fmt: skip
    """Trajectories of the fleets of a batch of scenes with bundles.

    Args:
        student: In evaluation mode.
        examples: Made for the student's number of samples.
        steps: Of DDIM; of a pair, the first is for the first try, the second for the others, and for whole fleets.
        tries: How many are drawn to choose from: the first for all, the others for drones that are not clear yet, if each
            drone is drawn on its own.
        seed: Of the noise; one for each scene, or the same for all. No scene's noise depends on the others.
        tokens: Of the scenes, if `decide` made them already.
    """
    apart = not student.settings.fleet_attention
    drawn = [(one.is_blocked if apart else one.active) for one in examples]
    wanted = [(index, int(drone)) for index, drones in enumerate(drawn) for drone in np.flatnonzero(drones)]
    seeds = [seed] * len(examples) if isinstance(seed, int) else seed
    generators = [torch.Generator().manual_seed(one) for one in seeds]
    tries_of: dict[Place, FloatArray] = {}
    drawings = [
        DrawnFleet(one.straight.copy(), ~one.is_blocked, int(drones.sum()), one)
        for one, drones in zip(examples, drawn, strict=True)
    ]
    pencil = _pencil(student, examples, tokens) if wanted else None
    first, later = (steps, steps) if isinstance(steps, int) else steps
    # With fleet attention a drone's second try would be of another fleet: all are made at once.
    for count, num_steps in ((1, first), (tries - 1, later)) if apart else ((tries, later),):
        if pencil is None or not count or not wanted:
            break
        noise = _noise(generators, wanted, (count, student.settings.num_samples))
        points = pencil(wanted, noise, num_steps)  # (count, R, T, 3) m
        for row, place in enumerate(wanted):
            tries_of[place] = np.concatenate([tries_of.get(place, points[:0, row]), points[:, row]])
            _choose(examples[place[0]], drawings[place[0]], place[1], tries_of[place])
        wanted = [(index, drone) for index, drone in wanted if not drawings[index].clear[drone]]
    return drawings


def _noise(generators: Sequence[torch.Generator], places: Sequence[Place], size: tuple[int, int]) -> Tensor:
    """(tries, R, T, 3): for places in the scenes' order, each scene's from its own generator; ``size`` is (tries, T)."""
    counts = np.bincount([index for index, _ in places], minlength=len(generators))
    parts = zip(counts.tolist(), generators, strict=True)
    noise = [torch.randn(size[0], count, size[1], 3, generator=generator) for count, generator in parts if count]
    return torch.cat(noise, dim=1)


#: From places, noise (tries, R, T, 3) and steps of DDIM to points of the noise's shape, metres.
Pencil: TypeAlias = Callable[[Sequence[Place], Tensor, int], FloatArray]


def _pencil(student: Network, examples: Sequence[Example], tokens: AgentTokens | None) -> Pencil:
    """What draws: row by row where the student can, else with whole fleets in view."""
    if student.draws_rows:
        known = student.decide(collate(examples))[1] if tokens is None else tokens

        def rows(places: Sequence[Place], noise: Tensor, steps: int) -> FloatArray:
            asked = rows_of(student.settings, known, examples, places)
            several = Rows(*(tensor.repeat(len(noise), *[1] * (tensor.dim() - 1)) for tensor in asked))
            residuals = student.sample(several, noise.flatten(0, 1), steps).view(noise.shape)
            return points_of(examples, places, residuals)

        return rows
    batch = collate(examples)

    def fleets(places: Sequence[Place], noise: Tensor, steps: int) -> FloatArray:
        scene, drone = torch.tensor(places).unbind(dim=1)
        points: FloatArray = student.draw(batch, scene, drone, noise, steps).double().numpy()
        return points

    return fleets


def _choose(one: Example, drawing: DrawnFleet, drone: int, tries: FloatArray) -> None:
    """Put the best of some tries (tries, T, 3) into the drawing; the straight way stays where none is finite."""
    finite = tries[np.isfinite(tries).all(axis=(1, 2))]
    if not len(finite):
        return
    radius = one.scene.drones[drone].radius
    tolerance, space = CHORD_TOLERANCE * radius, one.scene.free_space(radius + one.scene.clearance)
    if _shares_anchors(one, drone, finite):
        samples = one.straight[drone].copy()
        is_clear = best_legs(space, one.leg_end[drone], one.blocked[drone], samples, finite, tolerance)
    else:
        ways = [anchored_legs(one.scene, drone, one.routes[drone], samples) for samples in finite]
        ranked = [sum(rank(space, leg, tolerance) for leg in legs) for legs in ways]
        samples, is_clear = finite[int(np.argmin(ranked))], min(ranked) < np.inf
    drawing.samples[drone], drawing.clear[drone] = samples, is_clear


def _shares_anchors(one: Example, drone: int, tries: FloatArray) -> bool:
    places = np.concatenate([one.leg_begin[drone], one.leg_end[drone]])
    return bool(np.abs(tries[:, places] - one.straight[drone, places]).max() <= SAME_ANCHOR_M)
