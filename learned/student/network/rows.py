"""Drones that are drawn each on its own, whatever their fleet: what the network is told of them, and points from its answer.

The twin of `learned.student.network.model.Student.condition` for inference, by compiled code in place of many small tensor
operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flockopt.records.arrays import FloatArray
from learned.student.network.sample_features import add_residuals, told_of
from learned.student.network.scene_encoder import AgentTokens
from learned.student.scenes.examples import Example
from learned.student.settings import StudentSettings

__all__ = ["Place", "Rows", "points_of", "rows_of"]

#: Which scene of a batch, and which of its drones.
Place = tuple[int, int]


class Rows(NamedTuple):
    """What is told of R drones with up to L legs, each on its own; T samples in P patches."""

    drones: Tensor  # (R, D) their tokens
    goals: Tensor  # (R, L, D) the tokens of the tasks that their legs lead to
    is_task: Tensor  # (R, L) bool, whether there is such a task; a leg after the last one leads home
    num_legs: Tensor  # (R,) how many legs there are
    shares: Tensor  # (R, P, L) the share of each leg in each patch
    features: Tensor  # (R, T, 3 + F) after three zeros as `learned.student.network.leg_frame.sample_features` has them


def rows_of(settings: StudentSettings, tokens: AgentTokens, examples: Sequence[Example], places: Sequence[Place]) -> Rows:
    """What is told of some drones.

    Args:
        settings: The student's.
        tokens: Of the scenes of ``examples``.
        examples: Scenes with bundles.
        places: (R,) which drones.
    """
    longest = 1 + max(len(examples[index].routes[drone]) for index, drone in places)
    tasks = np.full((len(places), longest), -1)
    shares = np.zeros((len(places), settings.num_patches, longest), dtype=np.float32)
    patches = np.arange(settings.num_samples) // settings.patch  # (T,)
    for row, (index, drone) in enumerate(places):
        route = examples[index].routes[drone]
        tasks[row, : len(route)] = route
        np.add.at(shares[row], (patches, examples[index].leg_index[drone]), 1.0 / settings.patch)
    has_end = [examples[index].scene.drones[drone].end_point is not None for index, drone in places]
    features = np.stack([_features(settings, examples[index], drone) for index, drone in places])
    at = torch.tensor(places).unbind(dim=1)
    is_task, goals = tasks >= 0, tokens.tasks[at[0][:, None], torch.from_numpy(tasks)]
    arrays = is_task, is_task.sum(axis=1) + np.array(has_end), shares, features
    return Rows(tokens.drones[at], goals, *map(torch.from_numpy, arrays))


def _features(settings: StudentSettings, one: Example, drone: int) -> NDArray[np.float32]:
    need = one.scene.drones[drone].radius + one.scene.clearance
    way = one.leg_begin[drone], one.leg_end[drone], one.blocked[drone], one.straight[drone]
    return told_of(one.scene.free_space(need), need, *way, settings.nearest_obstacles)


def points_of(examples: Sequence[Example], places: Sequence[Place], residuals: Tensor) -> FloatArray:
    """(tries, R, T, 3) m: points from the residuals (tries, R, T, 3) of some drones, anchors exact."""
    points = np.empty(residuals.shape)
    for row, (index, drone) in enumerate(places):
        one = examples[index]
        way = one.leg_begin[drone], one.leg_end[drone], one.straight[drone]
        need = one.scene.drones[drone].radius + one.scene.clearance
        points[:, row] = add_residuals(need, *way, np.ascontiguousarray(residuals[:, row].numpy()))
    return points
