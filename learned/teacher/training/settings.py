"""What training can be told, checked once."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks

__all__ = ["METHODS", "TrainingSettings"]

#: What can be trained; `learned.teacher.allocators` has one method more.
METHODS = ("teacher", "magnnet")


@dataclass(frozen=True)
class TrainingSettings:
    """How to train an allocator; the defaults are those of the shipped weights.

    Attributes:
        method: One of `METHODS`.
        seed: Of everything random.
        iterations: How many batches of episodes to learn from.
        batch_size: Episodes of 10 drones and 20 tasks in a batch; of other sizes as many as weigh the same.
        pool_share: Of the problems that come from the scene pool; the rest has no obstacles.
        num_epochs: How often each batch is used.
        num_minibatches: Steps of the optimiser in each epoch.
        learning_rate: At the beginning; it falls linearly to zero.
        entropy_bonus: Weight of the entropy at the beginning; it falls linearly to zero.
        clip: See `ppo.clipped_policy_loss`.
        trace: lambda of the advantages.
        value_weight: Weight of the critic's loss.
        most_gradient: Longest gradient that is used unshortened.
        step_cost: What a step costs the team, as a share of about what serving all tasks costs.
        width: Of the networks.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    method: str = "teacher"
    seed: int = 0
    iterations: int = 500
    batch_size: int = 256
    pool_share: float = 0.75
    num_epochs: int = 3
    num_minibatches: int = 4
    learning_rate: float = 1.5e-3
    entropy_bonus: float = 0.01
    clip: float = 0.2
    trace: float = 0.95
    value_weight: float = 5.0
    most_gradient: float = 0.5
    step_cost: float = 0.002
    width: int = 64

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            value = f"is {checks.shown(self.method)}"
            raise SettingsError("method", value, f"must be one of {', '.join(METHODS)}", "choose one")
        for field, least in (("seed", 0), ("iterations", 1), ("batch_size", 8), ("num_epochs", 1), ("num_minibatches", 1)):
            self._set(field, checks.integer(SettingsError, field, getattr(self, field), least=least))
        self._set("width", checks.integer(SettingsError, "width", self.width, least=2))
        for field in ("learning_rate", "clip", "most_gradient"):
            self._set(field, checks.number(SettingsError, field, getattr(self, field), above=0.0))
        for field in ("pool_share", "entropy_bonus", "trace", "value_weight", "step_cost"):
            self._set(field, checks.number(SettingsError, field, getattr(self, field), least=0.0))
        for field in ("pool_share", "trace"):
            if not getattr(self, field) <= 1.0:
                raise SettingsError(field, f"is {getattr(self, field):g}", "must be in [0, 1]", "choose a share")

    def _set(self, field: str, value: Any) -> None:
        object.__setattr__(self, field, value)

    @property
    def slots(self) -> int | None:
        """How many tasks a drone may take in an episode: MAGNNET's take one, the teacher's as many as they can carry."""
        return 1 if self.method == "magnnet" else None

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainingSettings:
        """Settings from a JSON object; an unknown key is an error that lists the known ones."""
        return cls(**checks.keys(SettingsError, values, (), [field.name for field in dataclasses.fields(cls)]))
