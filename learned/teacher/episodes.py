"""Playing episodes with a policy, and keeping what training needs of them.

Episodes of a batch end at different steps. Those that have ended are left out of the steps that follow, so nothing is
computed for them; each `Moment` says which episodes it holds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from learned.teacher.descriptors import Observation, observe
from learned.teacher.environment import Choices, StepOutcome, choices, num_to_serve, reset, step
from learned.teacher.ppo import masked_log_softmax
from learned.teacher.problems import Problems

__all__ = ["Actor", "Moment", "decide", "play"]


class Actor(Protocol):
    """What `TeacherActor` and `MagnnetActor` have in common."""

    memory_width: int

    def __call__(self, observed: Observation, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Scores (B, N, K + 1) and memories (B, N, W)."""
        ...


@dataclass(frozen=True, eq=False)
class Moment:
    """One step of the episodes that still run, R of B.

    Attributes:
        rows: (R,) int64, which episodes, rising.
        observed: What was seen.
        actions: (R, N) what was named: a column of ``observed.tasks``, or K for idling.
        log_probs: (R, N) of these actions.
        memory: (R, N, W) after this step.
        outcome: What it brought.
        num_to_serve: (R,) what rewards are divided by.
    """

    rows: Tensor
    observed: Observation
    actions: Tensor
    log_probs: Tensor
    memory: Tensor
    outcome: StepOutcome
    num_to_serve: Tensor


def decide(log_probs: Tensor, generator: torch.Generator | None) -> Tensor:
    """(...) int64: a random action by its probability, or the likeliest one without a generator."""
    if generator is None:
        return log_probs.argmax(dim=-1)
    uniform = torch.rand(log_probs.shape, generator=generator).clamp(min=1e-20)
    return (log_probs - (-uniform.log()).log()).argmax(dim=-1)  # Gumbel's trick; minus infinity never wins


def play(
    actor: Actor,
    problems: Problems,
    *,
    generator: torch.Generator | None = None,
    slots: int | None = None,
    renews: bool = False,
    step_cost: float = 0.0,
) -> Iterator[Moment]:
    """Play a batch of episodes to their ends, step by step; to be used under ``torch.no_grad()``.

    Args:
        actor: Who decides.
        problems: The fleets.
        generator: Of random decisions; None takes the likeliest action.
        slots: See `environment.reset`.
        renews: Whether the slots are given anew after every step, so that drones are asked again until they are full.
        step_cost: See `environment.step`.

    Yields:
        Each step.
    """
    state = reset(problems, slots)
    fresh = state.slots
    rows = torch.arange(len(problems))
    memory = torch.zeros(*problems.capacity.shape, actor.memory_width)
    last_task = torch.full(problems.capacity.shape, -1)
    while True:
        options = choices(problems, state)
        if bool(options.is_over.any()):
            runs = ~options.is_over
            rows, problems, state, memory = rows[runs], problems[runs], state[runs], memory[runs]
            last_task, fresh = last_task[runs], fresh[runs]
            options = Choices(options.cost[runs], options.allowed[runs])
        if not len(rows):
            return
        observed = observe(problems, state, options, last_task)
        scores, memory = actor(observed, memory)
        log_probs = masked_log_softmax(scores, observed.allowed)
        actions = decide(log_probs, generator)
        chosen = log_probs.gather(2, actions[..., None])[..., 0]
        state, outcome = step(problems, state, options, _task_named(observed, actions, problems.num_tasks), step_cost=step_cost)
        if renews:
            state = replace(state, slots=fresh)
        yield Moment(rows, observed, actions, chosen, memory, outcome, num_to_serve(problems))
        last_task = outcome.taken


def _task_named(observed: Observation, actions: Tensor, idle: int) -> Tensor:
    """(R, N) tasks from columns of the observation."""
    idling = torch.full_like(observed.tasks[:, :1], idle)
    return torch.cat([observed.tasks, idling], dim=1).gather(1, actions)
