"""What the network of timed flights is built of, and what its training is told; both checked once."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.networks.schedule import Schedule

__all__ = ["MODES", "TimedNetworkSettings", "TimedTrainingSettings"]

#: ``regression`` answers at once; ``diffusion`` draws from noise.
MODES = ("regression", "diffusion")


@dataclass(frozen=True)
class TimedNetworkSettings:
    """The architecture; weights fit one of these only.

    Attributes:
        mode: One of `MODES`.
        width: Of tokens.
        blocks: Transformer blocks.
        heads: Attention heads.
        num_noise_levels: S in the paper.

    Raises:
        SettingsError: Naming the field, the value and the rule.
    """

    mode: str = "regression"
    width: int = 128
    blocks: int = 4
    heads: int = 4
    num_noise_levels: int = 1000

    def __post_init__(self) -> None:
        checks.store(self, checks.integer, SettingsError, "width", "blocks", "heads", "num_noise_levels", least=1)
        checks.store(self, checks.choice, SettingsError, "mode", known=MODES)
        if self.width % (2 * self.heads):
            raise SettingsError("width", f"is {self.width}", f"must be a multiple of {2 * self.heads}", "choose another")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TimedNetworkSettings:
        """Settings from a weight file's header; an unknown key is an error."""
        return checks.from_keys(SettingsError, cls, values)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for a weight file's header."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, kw_only=True)
class TimedTrainingSettings(Schedule):
    """A training of the network of timed flights.

    Attributes:
        mode: One of `MODES`.
        stages_per_step: How many it sees at once.
        cost_from: From this share of all steps on, the cost itself is minimised in place of the distance to the teacher.
        imitation_weight: Of that distance, from then on.
        room_m: The extra room that a stage is asked to keep is drawn between 0 and this, metres.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    mode: str = "regression"
    steps: int = 3600
    stages_per_step: int = 64
    ema_decay: float = 0.998
    cost_from: float = 0.0
    imitation_weight: float = 0.0
    room_m: float = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.store(self, checks.integer, SettingsError, "stages_per_step", least=1)
        checks.store(self, checks.number, SettingsError, "imitation_weight", "room_m", least=0.0)
        checks.store(self, checks.share, SettingsError, "cost_from")
        checks.store(self, checks.choice, SettingsError, "mode", known=MODES)
