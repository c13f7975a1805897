"""What the network of timed flights is built of, and what its training is told; both checked once."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.networks.training import PRECISIONS

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
        for field in ("width", "blocks", "heads", "num_noise_levels"):
            checks.integer(SettingsError, field, getattr(self, field), least=1)
        if self.width % (2 * self.heads):
            raise SettingsError("width", f"is {self.width}", f"must be a multiple of {2 * self.heads}", "choose another")
        _choice("mode", self.mode, MODES)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TimedNetworkSettings:
        """Settings from a weight file's header; an unknown key is an error."""
        return cls(**checks.keys(SettingsError, values, (), [field.name for field in dataclasses.fields(cls)]))

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for a weight file's header."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class TimedTrainingSettings:
    """A training run; the same settings and data give the same weights on the same machine.

    Attributes:
        mode: One of `MODES`.
        steps: Of the optimiser.
        stages_per_step: How many it sees at once.
        learning_rate: At its highest; it rises over ``warmup_steps`` and falls along a cosine.
        weight_decay: Of AdamW.
        ema_decay: Of the averaged weights, which are the ones that are shipped.
        cost_from: From this share of all steps on, the cost itself is minimised in place of the distance to the teacher.
        imitation_weight: Of that distance, from then on.
        room_m: The extra room that a stage is asked to keep is drawn between 0 and this, metres.
        clip: Greatest norm of a gradient.
        seed: Of weights, order, room, noise and mirroring.
        precision: One of `learned.student.training_settings.PRECISIONS`.

    Raises:
        SettingsError: Naming the field, the value and the rule.
    """

    mode: str = "regression"
    steps: int = 3600
    stages_per_step: int = 64
    learning_rate: float = 1e-3
    warmup_steps: int = 200
    weight_decay: float = 0.01
    ema_decay: float = 0.998
    cost_from: float = 0.0
    imitation_weight: float = 0.0
    room_m: float = 0.03
    clip: float = 1.0
    seed: int = 0
    precision: str = "auto"

    def __post_init__(self) -> None:
        for field in ("steps", "stages_per_step"):
            checks.integer(SettingsError, field, getattr(self, field), least=1)
        for field in ("warmup_steps", "seed"):
            checks.integer(SettingsError, field, getattr(self, field), least=0)
        for field in ("learning_rate", "clip"):
            checks.number(SettingsError, field, getattr(self, field), above=0.0)
        for field in ("weight_decay", "ema_decay", "cost_from", "imitation_weight", "room_m"):
            checks.number(SettingsError, field, getattr(self, field), least=0.0)
        for field in ("ema_decay", "cost_from"):
            if not getattr(self, field) <= 1.0:
                raise SettingsError(field, f"is {getattr(self, field):g}", "must be from 0 to 1", "give a share")
        _choice("mode", self.mode, MODES)
        _choice("precision", self.precision, PRECISIONS)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for file headers."""
        return dataclasses.asdict(self)


def _choice(field: str, value: object, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise SettingsError(field, f"is {checks.shown(value)}", f"must be one of {', '.join(choices)}", "choose one")
