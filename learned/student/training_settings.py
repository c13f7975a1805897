"""What a training run is told, checked once."""

from __future__ import annotations

from dataclasses import dataclass

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.networks.schedule import Schedule
from learned.student.loss import LossWeights
from learned.student.settings import CONFIGS

__all__ = ["StudentTrainingSettings"]


@dataclass(frozen=True, kw_only=True)
class StudentTrainingSettings(Schedule):
    """A training of a student.

    Attributes:
        config: One of `learned.student.settings.CONFIGS`.
        scenes_per_step: Over all processes.
        allocation_weight: Of the allocation's loss.
        diffusion_weight: Of the denoiser's loss.
        clearance_weight: Of the clearance penalty, from ``clearance_from`` of all steps on.
        clearance_from: A share of all steps.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    config: str = "small"
    steps: int = 12000
    scenes_per_step: int = 32
    ema_decay: float = 0.999
    allocation_weight: float = 1.0
    diffusion_weight: float = 1.0
    clearance_weight: float = 3.0
    clearance_from: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        weights = ("allocation_weight", "diffusion_weight", "clearance_weight")
        checks.store(self, checks.choice, SettingsError, "config", known=CONFIGS)
        checks.store(self, checks.integer, SettingsError, "scenes_per_step", least=1)
        checks.store(self, checks.number, SettingsError, *weights, least=0.0)
        checks.store(self, checks.share, SettingsError, "clearance_from")

    def loss_weights(self, step: int) -> LossWeights:
        """The weights of the loss's terms at a step."""
        is_fine_tuning = step >= self.clearance_from * self.steps
        return LossWeights(self.allocation_weight, self.diffusion_weight, self.clearance_weight if is_fine_tuning else 0.0)
