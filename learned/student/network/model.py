"""The student as a whole: scene tokens, allocation, conditions, and trajectories in its own coordinates."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TypeVar

import torch
from torch import Tensor, nn

from learned.networks.diffusion import ddim, noise_levels
from learned.student.network.allocation_head import AttentionHead, ProductHead
from learned.student.network.bundle_encoder import BundleEncoder
from learned.student.network.denoiser import Conditions, Denoiser
from learned.student.network.leg_frame import leg_frames, num_sample_features, sample_features, to_points, to_residuals
from learned.student.network.rows import Rows
from learned.student.network.scene_encoder import AgentTokens, SceneEncoder, SceneTokens
from learned.student.scenes.batch import FleetBatch, WayBatch
from learned.student.settings import StudentSettings

__all__ = ["Student"]

Record = TypeVar("Record", WayBatch, Conditions)


class Student(nn.Module):
    """FlockDiffusion's student in one of the configurations of `learned.student.settings.CONFIGS`."""

    #: (3,), what clean samples are divided by: their root mean square over the training data, kept with the weights.
    spread: Tensor

    def __init__(self, settings: StudentSettings) -> None:
        super().__init__()
        self.settings = settings
        width = settings.width
        self.encoder = SceneEncoder(settings.hidden, settings.rounds, width)
        self.head = AttentionHead(width, settings.heads) if settings.head == "attention" else ProductHead(width)
        self.bundle_encoder = BundleEncoder(width)
        nearest = settings.nearest_obstacles
        self.denoiser = Denoiser(settings, num_sample_features(nearest) if nearest else 0)
        self.register_buffer("spread", torch.ones(3))

    def ready(self) -> Student:
        """The same, its matrices stored the way in which few rows are multiplied with them soonest: for inference."""
        for layer in self.modules():
            if isinstance(layer, nn.Linear) and layer is not self.denoiser.samples_in:
                layer.weight.data = layer.weight.data.t().contiguous().t()
        return self.eval()

    @property
    def draws_rows(self) -> bool:
        """Whether `sample` may be asked: drones are drawn each on its own, in their legs' frames, at no place in the list."""
        settings = self.settings
        slots = settings.num_drone_slots
        return settings.frame == "leg" and settings.nearest_obstacles > 0 and not settings.fleet_attention and not slots

    def allocate(self, batch: FleetBatch, tokens: SceneTokens | AgentTokens | None = None) -> Tensor:
        """(B, M, N) log-probabilities: for every task, over drones."""
        tokens = self.encoder.agents(batch) if tokens is None else tokens
        return self.head(batch, tokens.drones, tokens.tasks)

    def decide(self, batch: FleetBatch) -> tuple[Tensor, AgentTokens]:
        """Log-probabilities as `allocate` gives them, and the tokens they come from, for `sample`."""
        tokens = self.encoder.agents(batch)
        return self.head(batch, tokens.drones, tokens.tasks), tokens

    def sample(self, rows: Rows, noise: Tensor, steps: int) -> Tensor:
        """(R, T, 3): residuals of some drones each on its own, by DDIM from noise of this shape.

        The same as `draw`, but that whatever does not change from step to step is computed once, and that residuals become
        points elsewhere (`learned.student.network.rows.points_of`).
        """
        num_levels = self.settings.num_noise_levels
        noise, steps = self._begun(noise, steps)
        legs, drones = self.bundle_encoder.legs(rows.goals, rows.is_task, rows.drones, rows.num_legs)
        told = self.denoiser.patches_of(rows.features, rows.shares @ legs)  # (R, P, D)
        levels = noise_levels(steps, num_levels)[:-1]
        modulations = iter(self.denoiser.modulations(drones, levels))

        def denoise(noisy: Tensor, _: Tensor) -> Tensor:
            return self.denoiser.alone(noisy, told, next(modulations))

        return ddim(denoise, noise, steps, num_levels) * self.spread

    def _begun(self, noise: Tensor, steps: int) -> tuple[Tensor, int]:
        """What DDIM begins with, and its steps: regression answers at once, whatever the noise."""
        return (torch.zeros_like(noise), 1) if self.settings.objective == "regression" else (noise, steps)

    def condition(
        self, batch: FleetBatch, rows: tuple[Tensor, Tensor] | None = None, tokens: SceneTokens | None = None
    ) -> tuple[WayBatch, Conditions]:
        """What the denoiser needs to know for all drones, or for some as scenes of their own: see `WayBatch.rows`.

        Only a student without fleet attention can tell drones apart from their fleet.
        """
        tokens = self.encoder(batch) if tokens is None else tokens
        legs, drones = self.bundle_encoder(batch, tokens)  # (B, N, R + 1, D), (B, N, D)
        ways = batch.ways
        if rows is not None:
            ways, legs, drones = ways.rows(*rows), legs[rows][:, None], drones[rows][:, None]
        index = ways.leg_index[..., None].expand(-1, -1, -1, self.settings.width)
        nearest = self.settings.nearest_obstacles
        features = sample_features(ways, leg_frames(ways), nearest) if nearest else None
        fleet = self.settings.fleet_attention
        scene, mask = (tokens.all, tokens.mask) if fleet else (None, None)
        return ways, Conditions(drones, legs.gather(2, index), features, scene, mask, ways.active)

    def clean_samples(self, ways: WayBatch) -> Tensor:
        """(B, N, T, 3): the targets in the student's own coordinates."""
        if ways.target is None:
            raise ValueError("these ways have no target")
        if self.settings.frame == "leg":
            return to_residuals(ways, leg_frames(ways), ways.target) / self.spread
        return ways.scaled(ways.target) / self.spread

    def points(self, ways: WayBatch, samples: Tensor) -> Tensor:
        """(B, N, T, 3) m: the inverse of `clean_samples`; in the legs' frames, anchors are exact."""
        if self.settings.frame == "leg":
            return to_points(ways, leg_frames(ways), samples * self.spread)
        return ways.unscaled(samples * self.spread)

    def draw(self, batch: FleetBatch, scene: Tensor, drone: Tensor, noise: Tensor, steps: int) -> Tensor:
        """(tries, R, T, 3) m: trajectories of some drones, by DDIM from noise (tries, R, T, 3).

        Args:
            batch: Scenes with bundles.
            scene: (R,) and
            drone: (R,) say which drones; with fleet attention the others' noise is zero.
            noise: Standard normal.
            steps: Of DDIM.
        """
        tries = noise.shape[0]
        apart = not self.settings.fleet_attention
        noise, steps = self._begun(noise, steps)
        ways, conditions = self.condition(batch, (scene, drone) if apart else None)
        ways, conditions = _repeated(ways, tries), _repeated(conditions, tries)
        if apart:
            whole = noise.flatten(0, 1)[:, None]  # (tries * R, 1, T, 3)
        else:
            whole = noise.new_zeros(tries, *batch.ways.straight.shape)
            whole[:, scene, drone] = noise
            whole = whole.flatten(0, 1)
        denoise = partial(self.denoiser, conditions=conditions)
        points = self.points(ways, ddim(denoise, whole, steps, self.settings.num_noise_levels))
        if apart:
            return points.view(noise.shape)
        return points.view(tries, *batch.ways.straight.shape)[:, scene, drone]


def _repeated(record: Record, tries: int) -> Record:
    """A record of tensors with its scenes repeated, all of them ``tries`` times."""
    tensors = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    several = {name: value.repeat(tries, *[1] * (value.dim() - 1)) for name, value in tensors.items() if value is not None}
    return dataclasses.replace(record, **several)
