"""The network of timed flights: a transformer over the joints of one stage, which says how each should change."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.networks.diffusion import ddim
from learned.networks.transformer import TransformerBlock, sinusoids, stack, zeroed
from learned.smoother.batch import MOST_JOINTS, StageBatch
from learned.smoother.features import NUM_FEATURES, stage_features
from learned.smoother.frame import RESIDUALS, flat_frames, free, states_of
from learned.smoother.settings import TimedNetworkSettings
from learned.smoother.spline import WISHES, flyable

__all__ = ["TimedNetwork"]

#: DDIM steps of an answer in the mode ``diffusion``.
STEPS = 2


class TimedNetwork(nn.Module):
    """Residuals of a stage's joints, at once or from noise; only joints of the same stage see each other.

    Attributes:
        spread: (10,) root mean squares of the teacher's residuals, which the network works in units of.
        log_wishes: (3,) logarithms of how much the states it wishes for weigh against jerk; learned.
    """

    spread: Tensor

    def __init__(self, settings: TimedNetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        width = settings.width
        self.register_buffer("spread", torch.ones(RESIDUALS))
        self.log_wishes = nn.Parameter(torch.tensor(WISHES).log())
        self.joint_in = nn.Sequential(nn.Linear(RESIDUALS + NUM_FEATURES, width), nn.SiLU(), nn.Linear(width, width))
        self.level_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.blocks = stack(TransformerBlock(width, settings.heads) for _ in range(settings.blocks))
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.joint_out = zeroed(nn.Linear(width, RESIDUALS))

    def forward(self, noisy: Tensor, noise_level: Tensor, features: Tensor, joints: Tensor) -> Tensor:
        """Clean residuals (B, J, 10) in units of their spread.

        Args:
            noisy: (B, J, 10).
            noise_level: (B,).
            features: (B, J, F).
            joints: (B, J) bool.
        """
        tokens = self.joint_in(torch.cat([noisy, features], dim=-1))  # (B, J, D)
        places = torch.arange(tokens.shape[1], device=tokens.device)
        tokens = tokens + sinusoids(places, self.settings.width, 2.0 * MOST_JOINTS)
        condition = nn.functional.silu(self.level_in(sinusoids(noise_level, self.settings.width)))[:, None]  # (B, 1, D)
        for block in self.blocks:
            tokens = block(tokens, condition, joints[:, None, None])
        return self.joint_out(self.norm(tokens))

    def changes(self, batch: StageBatch, frames: Tensor, extra: Tensor, noise: Tensor | None = None) -> Tensor:
        """Residuals (B, J, 10) in the drones' units.

        Args:
            batch: Stages.
            frames: (B, J, 2) of `flat_frames`.
            extra: (B,) extra room to ask for, units.
            noise: (B, J, 10) to begin with in the mode ``diffusion``.
        """
        features, chosen = stage_features(batch, frames, extra), free(batch)

        def denoise(noisy: Tensor, level: Tensor) -> Tensor:
            return self(noisy * chosen, level, features, batch.joints).float() * chosen

        start = torch.zeros(*batch.joints.shape, RESIDUALS, device=features.device) if noise is None else noise
        levels = self.settings.num_noise_levels
        if self.settings.mode == "regression":
            clean = denoise(torch.zeros_like(start), torch.full((len(start),), levels, device=start.device))
        else:
            clean = ddim(denoise, start, STEPS, levels)
        return clean * self.spread

    def propose(
        self, batch: StageBatch, extra: Tensor, noise: Tensor | None = None, shares: tuple[float, ...] = (1.0,)
    ) -> tuple[Tensor, Tensor]:
        """States and durations in the drones' units, arguments as for `changes`.

        ``shares`` are how much of the changes to wish for; each stage comes once for each of them in turn, so that states
        are (B * len(shares), J, 3, 3) and durations (B * len(shares), P).
        """
        frames, times = flat_frames(batch), len(shares)
        changes = self.changes(batch, frames, extra, noise).repeat_interleave(times, dim=0)
        scales = torch.tensor(shares, device=changes.device).repeat(len(extra))[:, None, None]
        return self.decoded(batch.repeated(times), frames.repeat_interleave(times, dim=0), changes * scales)

    def decoded(self, batch: StageBatch, frames: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
        """The smoothest states near those that residuals (B, J, 10) wish for, and their durations: see `flyable`."""
        wished, durations = states_of(batch, frames, changes)
        weights = self.log_wishes.exp().expand(*batch.joints.shape, 3)
        return flyable(batch, wished, durations, weights)
