"""The learned allocators: MAGNNET, MAGNNET with bundling, and the teacher, from scenes to bundles.

MAGNNET gives each drone one task. With bundling the same policy is asked again after every step, from where the routes end
by then, until the drones are full or tasks are gone.

    allocator = load_allocator("teacher")
    allocation = allocator.bundles([scene], [compute_travel(scene)])[0]
    allocation.routes  # which tasks each drone visits, in order

Decisions are the likeliest ones, so equal scenes get equal bundles. Nothing in the networks depends on the number of drones
or tasks: scenes larger than those of the training work, if less well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from flockopt.errors import SettingsError
from flockopt.records import checks
from flockopt.scene import Scene
from flockopt.travel import Travel
from learned.networks.shipped import shipped_path
from learned.teacher.actors.networks import load_actor
from learned.teacher.episodes import Actor, play
from learned.teacher.problems import Problems

__all__ = ["ALLOCATORS", "Allocation", "Allocator", "load_allocator"]

#: How many drone-task pairs are decided on at a time; bounds the memory that large scenes take.
MOST_PAIRS = 200_000


@dataclass(frozen=True)
class Allocation:
    """What an allocator answers.

    Attributes:
        routes: N tuples of task indices in visiting order; tasks in none of them are not served.
        steps: Episode steps: how often the drones were asked.
        log_prob: Log-probability of all decisions together.
    """

    routes: tuple[tuple[int, ...], ...]
    steps: int
    log_prob: float


@dataclass(frozen=True)
class Allocator:
    """An actor, and how it is asked.

    Attributes:
        method: One of `ALLOCATORS`.
        actor: The trained network.
    """

    method: str
    actor: Actor

    def bundles(self, scenes: Sequence[Scene], travels: Sequence[Travel]) -> list[Allocation]:
        """Bundles for every scene; scenes are decided together, a memory's worth at a time.

        Args:
            scenes: At least one.
            travels: The travel of each.

        Raises:
            SettingsError: If there is no scene, or not one travel for each.
        """
        problems = Problems.of(scenes, travels)
        if problems.num_tasks == 0:
            return [Allocation(((),) * scene.num_drones, 0, 0.0) for scene in scenes]
        at_a_time = max(MOST_PAIRS // (problems.num_drones * problems.num_tasks), 1)
        found: list[Allocation] = []
        for begin in range(0, len(scenes), at_a_time):
            found += self._decided(problems[begin : begin + at_a_time])
        return [
            replace(allocation, routes=allocation.routes[: scene.num_drones])
            for allocation, scene in zip(found, scenes, strict=True)
        ]

    def _decided(self, problems: Problems) -> list[Allocation]:
        routes: list[list[list[int]]] = [[[] for _ in range(problems.num_drones)] for _ in range(len(problems))]
        steps, log_probs = torch.zeros(len(problems)), torch.zeros(len(problems))
        how = ALLOCATORS[self.method]
        with torch.inference_mode():
            for moment in play(self.actor, problems, slots=how.slots, renews=how.renews):
                steps[moment.rows] += 1
                log_probs[moment.rows] += moment.log_probs.sum(dim=1)
                for row, drone in (moment.outcome.taken >= 0).nonzero().tolist():
                    routes[int(moment.rows[row])][drone].append(int(moment.outcome.taken[row, drone]))
        return [
            Allocation(tuple(tuple(route) for route in fleet), int(count), float(log_prob))
            for fleet, count, log_prob in zip(routes, steps, log_probs, strict=True)
        ]


def load_allocator(method: str, weights: str | Path | None = None) -> Allocator:
    """An allocator with its trained weights.

    Args:
        method: One of `ALLOCATORS`.
        weights: Its weight file; None takes the one that comes with the package.

    Raises:
        SettingsError: On an unknown method, or a weight file that is missing, damaged or foreign.
    """
    trained_as = ALLOCATORS[checks.choice(SettingsError, "method", method, known=ALLOCATORS)].trained_as
    return Allocator(method, load_actor(trained_as, weights or shipped_path(trained_as)))


@dataclass(frozen=True)
class _Method:
    """How an allocator decides: whose weights it has, and how it plays.

    Attributes:
        trained_as: The method that was trained.
        slots: How many tasks a drone may take, or None for as many as it can carry.
        renews: Whether it may take as many again after every step.
    """

    trained_as: str
    slots: int | None = None
    renews: bool = False


ALLOCATORS: dict[str, _Method] = {
    "magnnet": _Method("magnnet", slots=1),
    "magnnet-bundling": _Method("magnnet", slots=1, renews=True),
    "teacher": _Method("teacher"),
}
