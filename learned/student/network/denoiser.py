"""The diffusion transformer: from noisy samples of a fleet to clean ones (adaLN-zero, Peebles and Xie 2023)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from learned.networks.transformer import TransformerBlock, sinusoids, stack, zeroed
from learned.student.settings import StudentSettings

__all__ = ["Conditions", "Denoiser"]


@dataclass(frozen=True)
class Conditions:
    """What the denoiser is told besides noisy samples and the noise level.

    Attributes:
        drones: (B, N, D) drone tokens.
        legs: (B, N, T, D) the token of each sample's leg.
        features: (B, N, T, F) of each sample, or None.
        scene: (B, U, D) scene tokens, or None without fleet attention.
        scene_mask: (B, U) bool.
        active: (B, N) bool.
    """

    drones: Tensor
    legs: Tensor
    features: Tensor | None
    scene: Tensor | None
    scene_mask: Tensor | None
    active: Tensor

    def rows(self, chosen: slice) -> Conditions:
        """Those of some scenes."""
        tensors = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        parts: dict[str, Any] = {name: None if value is None else value[chosen] for name, value in tensors.items()}
        return Conditions(**parts)


class Denoiser(nn.Module):
    """f_theta in the paper; predicts the clean samples."""

    def __init__(self, settings: StudentSettings, num_features: int) -> None:
        super().__init__()
        self.settings = settings
        width, patch = settings.width, settings.patch
        self.samples_in = nn.Linear(patch * (3 + num_features), width)
        self.leg_in = nn.Linear(width, width)
        self.time_embedding = nn.Parameter(0.02 * torch.randn(settings.num_patches, width))
        slots = settings.num_drone_slots
        self.drone_slots = nn.Parameter(0.02 * torch.randn(slots, width)) if slots else None
        self.level_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.drone_in = nn.Linear(width, width)
        self.blocks = stack(TransformerBlock(width, settings.heads) for _ in range(settings.blocks))
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.modulation = zeroed(nn.Linear(width, 2 * width))
        self.samples_out = zeroed(nn.Linear(width, patch * 3))

    def forward(self, noisy: Tensor, noise_level: Tensor, conditions: Conditions) -> Tensor:
        """Clean samples (B, N, T, 3) from noisy ones; ``noise_level`` (B,) is t in the paper."""
        batch, num_drones, num_samples, _ = noisy.shape
        patches = self.settings.num_patches
        whole = noisy if conditions.features is None else torch.cat([noisy, conditions.features], dim=-1)
        tokens = self.samples_in(whole.reshape(batch, num_drones, patches, self.samples_in.in_features))  # (B, N, P, D)
        legs = conditions.legs.view(batch, num_drones, patches, self.settings.patch, self.settings.width).mean(dim=3)
        tokens = tokens + self.leg_in(legs) + self.time_embedding
        if self.drone_slots is not None:
            tokens = tokens + self.drone_slots[:num_drones, None]
        level = self.level_in(sinusoids(noise_level, self.settings.width))  # (B, D)
        drones = nn.functional.silu(level[:, None] + self.drone_in(conditions.drones))  # (B, N, D)
        if self.settings.fleet_attention:
            tokens, drones = self._jointly(tokens, drones, level, conditions)
        else:
            tokens, drones = self._apart(tokens, drones)
        shift, scale = self.modulation(drones).chunk(2, dim=-1)
        out = self.samples_out(self.norm(tokens) * (1.0 + scale) + shift)
        return out.reshape(batch, num_drones, num_samples, 3)

    def _jointly(self, tokens: Tensor, drones: Tensor, level: Tensor, conditions: Conditions) -> tuple[Tensor, Tensor]:
        """All drones' tokens and the scene's attend to each other; trajectory tokens (B, N * P, D) come back."""
        batch, _, patches, width = tokens.shape
        if conditions.scene is None or conditions.scene_mask is None:
            raise ValueError("fleet attention needs scene tokens")
        vectors = torch.cat(
            [nn.functional.silu(level)[:, None].expand(-1, conditions.scene.shape[1], -1),
             drones[:, :, None].expand(-1, -1, patches, -1).reshape(batch, -1, width)], dim=1,
        )  # fmt: skip
        sequence = torch.cat([conditions.scene, tokens.reshape(batch, -1, width)], dim=1)
        active = conditions.active[..., None].expand(-1, -1, patches).reshape(batch, -1)
        mask = torch.cat([conditions.scene_mask, active], dim=1)[:, None, None]  # (B, 1, 1, U + N P)
        for block in self.blocks:
            sequence = block(sequence, vectors, mask)
        num_scene = conditions.scene.shape[1]
        return sequence[:, num_scene:], vectors[:, num_scene:]

    def _apart(self, tokens: Tensor, drones: Tensor) -> tuple[Tensor, Tensor]:
        """Each drone's tokens attend to each other only; trajectory tokens (B * N, P, D) come back."""
        rows, vectors = tokens.flatten(0, 1), drones.flatten(0, 1)[:, None]
        for block in self.blocks:
            rows = block(rows, vectors, None)
        return rows, vectors

    def patches_of(self, features: Tensor, legs: Tensor) -> Tensor:
        """(R, P, D): all that does not change with noise and its level, of drones each on its own.

        Args:
            features: (R, T, 3 + F) of each sample, after three zeros in the place of the noisy sample.
            legs: (R, P, D) the mean of the leg tokens of each patch's samples.
        """
        told = self.samples_in(features.reshape(features.shape[0], self.settings.num_patches, -1))
        return told + self.leg_in(legs) + self.time_embedding

    def modulations(self, drones: Tensor, levels: Sequence[int]) -> list[tuple[Tensor, ...]]:
        """For each noise level what drone tokens (R, D) do to each block, and to the output: (R, 1, 6 D), last (R, 1, 2 D)."""
        level = self.level_in(sinusoids(torch.tensor(levels, device=drones.device), self.settings.width))  # (levels, D)
        vectors = nn.functional.silu(level[:, None, None] + self.drone_in(drones)[:, None])  # (levels, R, 1, D)
        layers = [*(block.modulation for block in self.blocks), self.modulation]
        return list(zip(*(layer(vectors).unbind() for layer in layers), strict=True))

    def alone(self, noisy: Tensor, told: Tensor, modulations: Sequence[Tensor]) -> Tensor:
        """Clean samples (R, T, 3) of drones each on its own: `forward` with what stays from step to step computed before."""
        # the layer is linear in samples and features: its part for features is in ``told`` already, bias included
        weight = self.samples_in.weight.unflatten(1, (self.settings.patch, -1))[:, :, :3].flatten(1)
        tokens = told + nn.functional.linear(noisy.reshape(*told.shape[:2], -1), weight)
        for block, modulation in zip(self.blocks, modulations[:-1], strict=True):
            tokens = block.modulated(tokens, modulation, None)
        shift, scale = modulations[-1].chunk(2, dim=-1)
        return self.samples_out(torch.addcmul(shift, self.norm(tokens), 1.0 + scale)).reshape(noisy.shape)
