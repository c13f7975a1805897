"""What training can be told, checked once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks

__all__ = ["METHODS", "AllocatorTrainingSettings"]

#: What can be trained; `learned.teacher.allocators` has one method more.
METHODS = ("teacher", "magnnet")


@dataclass(frozen=True)
class AllocatorTrainingSettings:
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
        checks.store(self, checks.choice, SettingsError, "method", known=METHODS)
        for field, least in (("seed", 0), ("batch_size", 8), ("width", 2)):
            checks.store(self, checks.integer, SettingsError, field, least=least)
        checks.store(self, checks.integer, SettingsError, "iterations", "num_epochs", "num_minibatches", least=1)
        checks.store(self, checks.number, SettingsError, "learning_rate", "clip", "most_gradient", above=0.0)
        checks.store(self, checks.number, SettingsError, "entropy_bonus", "value_weight", "step_cost", least=0.0)
        checks.store(self, checks.share, SettingsError, "pool_share", "trace")

    @property
    def slots(self) -> int | None:
        """How many tasks a drone may take in an episode: MAGNNET's take one, the teacher's as many as they can carry."""
        return 1 if self.method == "magnnet" else None

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> AllocatorTrainingSettings:
        """Settings from a JSON object; an unknown key is an error that lists the known ones."""
        return checks.from_keys(SettingsError, cls, values)
