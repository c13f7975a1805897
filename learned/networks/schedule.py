"""What every training of a network is told: how long, how fast, how it is averaged; and the learning rate that follows."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks

__all__ = ["PRECISIONS", "Schedule"]

#: ``auto`` is bfloat16 where the hardware multiplies in it, float32 elsewhere.
PRECISIONS = ("auto", "float32", "bfloat16")

#: The learning rate ends at this share of its highest.
LAST_RATE = 0.02


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """A training run; the same settings and data give the same weights on the same machine.

    Attributes:
        steps: Of the optimiser.
        learning_rate: At its highest; it rises over ``warmup_steps`` and falls along a cosine.
        warmup_steps: How many.
        weight_decay: Of AdamW.
        ema_decay: Of the averaged weights, which are the ones that are shipped.
        clip: Greatest norm of a gradient.
        seed: Of everything random: weights, order, noise and mirroring.
        precision: One of `PRECISIONS`.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    steps: int
    learning_rate: float = 1e-3
    warmup_steps: int = 200
    weight_decay: float = 0.01
    ema_decay: float
    clip: float = 1.0
    seed: int = 0
    precision: str = "auto"

    def __post_init__(self) -> None:
        checks.store(self, checks.integer, SettingsError, "steps", least=1)
        checks.store(self, checks.integer, SettingsError, "warmup_steps", "seed", least=0)
        checks.store(self, checks.number, SettingsError, "learning_rate", "clip", above=0.0)
        checks.store(self, checks.number, SettingsError, "weight_decay", least=0.0)
        checks.store(self, checks.share, SettingsError, "ema_decay")
        checks.store(self, checks.choice, SettingsError, "precision", known=PRECISIONS)

    def rate_at(self, step: int) -> float:
        """The learning rate of a step: it rises, then falls along a cosine (Loshchilov and Hutter 2017)."""
        return self.learning_rate * self._share_at(step)

    def _share_at(self, step: int) -> float:
        if step < self.warmup_steps:
            return (step + 1) / self.warmup_steps
        done = (step - self.warmup_steps) / max(self.steps - self.warmup_steps, 1)
        return LAST_RATE + (1.0 - LAST_RATE) * 0.5 * (1.0 + math.cos(math.pi * done))

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for file headers."""
        return dataclasses.asdict(self)
