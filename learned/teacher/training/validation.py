"""How good an actor is on scenes that training never sees: the figures of the learning curves.

The teacher is measured by how much farther its fleets travel than the best known allocation (the search of flockopt with
its default effort); MAGNNET, whose drones take one task each, by how much its assignment costs above the optimal one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flockopt.bundles.refine import refine_bundles
from flockopt.scene.families.generate import generate
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel.compute import compute_travel
from learned.teacher.episodes import Actor, play
from learned.teacher.problems import Problems
from learned.teacher.training.scene_pool import FIRST_VALIDATION_SEED

__all__ = ["ValidationSet", "optimal_one_task_cost"]


@dataclass(frozen=True, eq=False)
class ValidationSet:
    """Scenes of 10 drones and 20 tasks from all families, and what serving them costs at best.

    Attributes:
        problems: The scenes.
        slots: See `environment.reset`.
        reference: (B,) m, the cost to be compared with.
    """

    problems: Problems
    slots: int | None
    reference: Tensor

    @staticmethod
    def make(slots: int | None, scenes_a_family: int = 20) -> ValidationSet:
        """The validation scenes of every family, the same at every call."""
        seeds = range(FIRST_VALIDATION_SEED, FIRST_VALIDATION_SEED + scenes_a_family)
        scenes = [generate(family, drones=10, tasks=20, seed=seed) for family in FAMILIES for seed in seeds]
        travels = [compute_travel(scene) for scene in scenes]
        if slots == 1:
            reference = [optimal_one_task_cost(travel.start_task) for travel in travels]
        else:
            reference = [
                travel.total(refine_bundles(scene, travel=travel).routes) for scene, travel in zip(scenes, travels, strict=True)
            ]
        return ValidationSet(Problems.of(scenes, travels), slots, torch.tensor(reference))

    def excess(self, actor: Actor) -> tuple[float, float]:
        """How much more an actor's likeliest decisions cost than the reference, in the mean, and their mean steps."""
        cost, steps = torch.zeros(len(self.problems)), torch.zeros(len(self.problems))
        with torch.no_grad():
            for moment in play(actor, self.problems, slots=self.slots):
                cost[moment.rows] += moment.outcome.cost.sum(dim=1) * self.problems.scale[moment.rows]
                steps[moment.rows] += 1
        return float(cost.sum() / self.reference.sum()) - 1.0, float(steps.mean())


def optimal_one_task_cost(start_task: np.ndarray) -> float:
    """Least total cost of as many one-task assignments as there can be, by the Hungarian method; (N, M) m of legs."""
    from scipy.optimize import linear_sum_assignment

    return float(start_task[linear_sum_assignment(start_task)].sum())
