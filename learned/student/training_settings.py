"""What a training run is told, checked once."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.networks.training import PRECISIONS
from learned.student.loss import LossWeights
from learned.student.settings import CONFIGS

__all__ = ["TrainingSettings"]


@dataclass(frozen=True)
class TrainingSettings:
    """A training run; the same settings and data give the same weights on the same machine.

    Attributes:
        config: One of `learned.student.settings.CONFIGS`.
        steps: Of the optimiser.
        scenes_per_step: Over all processes.
        learning_rate: At its highest; it rises over ``warmup_steps`` and falls along a cosine.
        weight_decay: Of AdamW.
        ema_decay: Of the averaged weights, which are the ones that are shipped.
        clearance_weight: Of the clearance penalty, from ``clearance_from`` of all steps on.
        clip: Greatest norm of a gradient.
        seed: Of weights, order, noise and mirroring.
        precision: One of `PRECISIONS`.

    Raises:
        SettingsError: Naming the field, the value and the rule.
    """

    config: str = "small"
    steps: int = 12000
    scenes_per_step: int = 32
    learning_rate: float = 1e-3
    warmup_steps: int = 200
    weight_decay: float = 0.01
    ema_decay: float = 0.999
    allocation_weight: float = 1.0
    diffusion_weight: float = 1.0
    clearance_weight: float = 3.0
    clearance_from: float = 0.3
    clip: float = 1.0
    seed: int = 0
    precision: str = "auto"

    def __post_init__(self) -> None:
        for field in ("steps", "scenes_per_step"):
            checks.integer(SettingsError, field, getattr(self, field), least=1)
        for field in ("warmup_steps", "seed"):
            checks.integer(SettingsError, field, getattr(self, field), least=0)
        for field in ("learning_rate", "clip"):
            checks.number(SettingsError, field, getattr(self, field), above=0.0)
        for field in (
            "weight_decay",
            "allocation_weight",
            "diffusion_weight",
            "clearance_weight",
            "clearance_from",
            "ema_decay",
        ):
            checks.number(SettingsError, field, getattr(self, field), least=0.0)
        for field in ("ema_decay", "clearance_from"):
            if not getattr(self, field) <= 1.0:
                raise SettingsError(field, f"is {getattr(self, field):g}", "must be from 0 to 1", "give a share")
        for field, choices in (("config", tuple(CONFIGS)), ("precision", PRECISIONS)):
            if getattr(self, field) not in choices:
                value = f"is {getattr(self, field)!r}"
                raise SettingsError(field, value, f"must be one of {', '.join(choices)}", "choose one")

    def loss_weights(self, step: int) -> LossWeights:
        """The weights of the loss's terms at a step."""
        is_fine_tuning = step >= self.clearance_from * self.steps
        return LossWeights(self.allocation_weight, self.diffusion_weight, self.clearance_weight if is_fine_tuning else 0.0)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for file headers."""
        return dataclasses.asdict(self)
