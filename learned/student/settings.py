"""What a student is built of, and the two configurations: the paper's, and a smaller one that learns faster."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks

__all__ = ["CONFIGS", "FRAMES", "HEADS", "OBJECTIVES", "StudentSettings"]

#: Where trajectories are measured: in the scene, or in each leg's own frame as residuals from the straight leg.
FRAMES = ("scene", "leg")

#: Allocation heads: the paper's scaled products, or attention that knows distances.
HEADS = ("product", "attention")

#: What the denoiser learns: to remove noise of any level, or to answer at once, without noise (plain regression).
OBJECTIVES = ("diffusion", "regression")


@dataclass(frozen=True)
class StudentSettings:
    """The architecture of a student; weights fit one of these only.

    Attributes:
        hidden: Width of the scene graph's message passing.
        rounds: Rounds of message passing.
        width: Width of tokens and of the denoiser.
        blocks: Transformer blocks of the denoiser.
        heads: Attention heads, in the denoiser and in the attention head.
        num_samples: Samples of a drone's trajectory, T in the paper.
        patch: Samples in a token.
        num_noise_levels: S in the paper.
        frame: One of `FRAMES`.
        head: One of `HEADS`.
        fleet_attention: Whether the trajectory tokens of all drones and the scene tokens attend to each other jointly; a
            drone's tokens attend to each other only otherwise.
        num_drone_slots: Rows of the learned drone embedding, which ties outputs to the drones' order; 0 derives it from
            the drone's scene token, so that drones may be relabelled at will and be as many as one likes.
        nearest_obstacles: How many obstacles each sample of the straight way is told of; 0 in the paper.
        objective: One of `OBJECTIVES`.

    Raises:
        SettingsError: Naming the field, the value and the rule.
    """

    hidden: int = 128
    rounds: int = 3
    width: int = 256
    blocks: int = 8
    heads: int = 8
    num_samples: int = 64
    patch: int = 4
    num_noise_levels: int = 1000
    frame: str = "scene"
    head: str = "product"
    fleet_attention: bool = True
    num_drone_slots: int = 20
    nearest_obstacles: int = 0
    objective: str = "diffusion"

    def __post_init__(self) -> None:
        positive = ("hidden", "rounds", "width", "blocks", "heads", "num_samples", "patch", "num_noise_levels")
        checks.store(self, checks.integer, SettingsError, *positive, least=1)
        checks.store(self, checks.integer, SettingsError, "num_drone_slots", "nearest_obstacles", least=0)
        checks.store(self, checks.flag, SettingsError, "fleet_attention")
        for field, known in (("frame", FRAMES), ("head", HEADS), ("objective", OBJECTIVES)):
            checks.store(self, checks.choice, SettingsError, field, known=known)
        for field, whole, part in (("num_samples", self.num_samples, self.patch), ("width", self.width, 2 * self.heads)):
            if whole % part:
                raise SettingsError(field, f"is {whole}", f"must be a multiple of {part}", "choose another")

    @property
    def num_patches(self) -> int:
        """Trajectory tokens of a drone."""
        return self.num_samples // self.patch

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> StudentSettings:
        """Settings from a weight file's header; an unknown key is an error."""
        return checks.from_keys(SettingsError, cls, values)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for a weight file's header."""
        return dataclasses.asdict(self)


SMALL = StudentSettings(
    width=128, blocks=4, heads=4, frame="leg", head="attention", fleet_attention=False, num_drone_slots=0, nearest_obstacles=4,
)  # fmt: skip

#: The configurations by name: the paper's, the default, and the default with one part changed, to see what it is worth.
CONFIGS: dict[str, StudentSettings] = {
    "paper": StudentSettings(),
    "small": SMALL,
    "small-regression": replace(SMALL, objective="regression"),
    "small-scene-frame": replace(SMALL, frame="scene"),
    "small-fleet-attention": replace(SMALL, fleet_attention=True),
}
