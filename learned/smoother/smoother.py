"""Flights smoothed by the network of timed flights: one pass for the whole fleet, then only what holds is taken.

A planner hands `smooth_flights` to the pipeline as its proposal's ``smoother`` (docs/adding-a-planner.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flockopt.errors import require
from flockopt.flights import Flight
from flockopt.flights.smoothing.proposals import fly_proposals
from flockopt.flights.smoothing.stages import Stage
from flockopt.scene import Drone, Scene
from learned.networks.shipped import load_once, shipped_path

if TYPE_CHECKING:
    from torch import Tensor

    from learned.smoother.batch import UnitStage
    from learned.smoother.model import TimedNetwork

__all__ = ["WEIGHTS", "NetworkProposer", "shipped_timed", "smooth_flights"]

#: The weights that come with the package.
WEIGHTS = shipped_path("student-timed")

#: How much of the changes that the network asks for to wish for: a proposal each, the boldest first.
SHARES = (1.0, 0.85, 0.7)


@dataclass(frozen=True, eq=False)
class NetworkProposer:
    """A network as a `flockopt.flights.smoothing.proposals.Proposer`.

    Attributes:
        network: In evaluation mode.
        shares: Of the network's changes; a proposal for each.
        seed: Of the noise that the mode ``diffusion`` begins with.
    """

    network: TimedNetwork
    shares: tuple[float, ...] = SHARES
    seed: int = 0

    def __call__(self, scene: Scene, stages: Sequence[tuple[Drone, Stage]]) -> list[list[Stage]]:
        """Proposals for each stage; none for stages of more joints than the network takes."""
        import torch

        from learned.demonstrations.timed_shards import StageRecord
        from learned.smoother.batch import MOST_JOINTS, collate_stages, unit_stage

        result: list[list[Stage]] = [[] for _ in stages]
        asked = [index for index, (_, stage) in enumerate(stages) if len(stage.states) <= MOST_JOINTS]
        if not asked:
            return result
        units = [unit_stage(StageRecord.of(scene, *stages[index])) for index in asked]
        batch = collate_stages(units)
        with torch.inference_mode():
            noise = torch.randn(*batch.joints.shape, 10, generator=torch.Generator().manual_seed(self.seed))
            states, durations = self.network.propose(batch, torch.zeros_like(batch.need), noise, self.shares)
        for row, index in enumerate(np.repeat(asked, len(self.shares))):
            drone, stage = stages[index]
            result[index].append(_stage(drone, stage, units[row // len(self.shares)], states[row], durations[row]))
        return result


def _stage(drone: Drone, guess: Stage, unit: UnitStage, states: Tensor, durations: Tensor) -> Stage:
    """The network's answer in metres and seconds, between the ends of the guess; the changes are added in double precision."""
    time = drone.max_speed / drone.flyable_acceleration
    scale = unit.length_m * np.array([[1.0], [1.0 / time], [1.0 / time**2]])
    moved = (states[: len(guess.states)].numpy().astype(np.float64) - unit.states) * scale
    moved[[0, -1]] = 0.0
    longer = durations[: len(guess.durations)].numpy().astype(np.float64) / unit.durations
    return replace(guess, states=guess.states + moved, durations=guess.durations * longer)


def shipped_timed(path: Path = WEIGHTS) -> TimedNetwork:
    """The network whose weights come with the package, loaded once.

    Raises:
        SettingsError: If the weights are missing or damaged.
        MissingExtra: If torch or safetensors is not installed.
    """
    require("torch", extra="learned")
    from learned.smoother.checkpoint import load_timed

    return load_once(load_timed, path)


def smooth_flights(scene: Scene, flights: dict[str, Flight]) -> dict[str, Flight]:
    """Flights that take less time and jerk, where the network finds them; the others as they are.

    Raises:
        SettingsError: If the shipped weights are missing or damaged.
        MissingExtra: If torch or safetensors is not installed.
    """
    network = shipped_timed()
    from learned.networks.threads import threads_for

    with threads_for(len(flights) + sum(len(flight.visits) for flight in flights.values())):
        reports = fly_proposals(scene, flights, NetworkProposer(network))
    return {name: each.flight for name, each in reports.items()}
