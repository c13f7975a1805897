"""The allocation environment: thousands of fleets choose tasks step by step, as pure functions on tensors.

A step: every drone names a task or idles. Of the drones that name one task, the one with the least marginal cost takes
it, ties going to the lower index; the losers keep their turn for the next step. A task is appended to its drone's route,
so its marginal cost is the leg from the route's end, plus what the way to the drone's own end changes by.

A choice is allowed if the task is open, fits in the remaining capacity and slots, can be reached, and keeps
``max_distance``. Idling is always allowed, but for one case: after a step in which nobody took a task, drones with an
allowed task must name one. So every two steps at least one task is taken, and no policy can idle for ever. An episode
ends when no drone has an allowed task: all tasks are taken or all slots are full.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from learned.teacher.problems import Problems

__all__ = ["AT_START", "FAR", "Choices", "FleetState", "StepOutcome", "choices", "num_to_serve", "reset", "step"]

#: The place of a drone that has taken no task yet.
AT_START = -1

#: What an impossible leg costs, in units of the scale; finite, so that arithmetic on it stays finite.
FAR = 1e4


@dataclass(frozen=True, eq=False)
class FleetState:
    """Where a batch of episodes stands; lengths in units of the problem's scale.

    Attributes:
        legs: (B, N, M) from each drone's route end to each task; `FAR` where there is no way.
        to_end: (B, N) from each drone's route end to its own end, 0 where it has none.
        is_open: (B, M) bool, tasks that nobody has taken.
        remaining: (B, N) capacity that is left.
        slots: (B, N) how many tasks a drone may still take in this episode.
        place: (B, N) int64, the task at each route's end or `AT_START`.
        travelled: (B, N).
        is_stalled: (B,) bool, whether nobody took a task in the last step.
    """

    legs: Tensor
    to_end: Tensor
    is_open: Tensor
    remaining: Tensor
    slots: Tensor
    place: Tensor
    travelled: Tensor
    is_stalled: Tensor

    def __getitem__(self, rows: Tensor | slice) -> FleetState:
        return FleetState(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class Choices:
    """What drones may do in a state.

    Attributes:
        cost: (B, N, M) what appending a task adds to a drone's route, in units of the scale; about `FAR` where there is
            no way.
        allowed: (B, N, M + 1) bool: tasks a drone may name and, at the end, whether it may idle.
    """

    cost: Tensor
    allowed: Tensor

    @property
    def is_over(self) -> Tensor:
        """(B,) bool, whether no drone may take a task."""
        return ~self.allowed[..., :-1].flatten(1).any(dim=1)


@dataclass(frozen=True, eq=False)
class StepOutcome:
    """What a step brought.

    Attributes:
        taken: (B, N) int64, the task each drone took, or -1.
        cost: (B, N) its marginal cost in units of the scale, 0 for who took none.
        reward: (B,) of the team.
    """

    taken: Tensor
    cost: Tensor
    reward: Tensor


def reset(problems: Problems, slots: int | None = None) -> FleetState:
    """The beginning of an episode.

    Args:
        problems: The fleets.
        slots: How many tasks a drone may take in the episode; None leaves that to its capacity.
    """
    scale = problems.scale[:, None]
    shape = problems.capacity.shape
    return FleetState(
        legs=_finite(problems.start_task / scale[..., None]),
        to_end=_finite(problems.start_end / scale),
        is_open=problems.task_mask.clone(),
        remaining=problems.capacity.clone(),
        slots=torch.full(shape, float(problems.num_tasks if slots is None else slots)),
        place=torch.full(shape, AT_START),
        travelled=torch.zeros(shape),
        is_stalled=torch.zeros(shape[0], dtype=torch.bool),
    )


def _finite(lengths: Tensor) -> Tensor:
    return lengths.clamp(max=FAR)


def num_to_serve(problems: Problems) -> Tensor:
    """(B,) how many tasks there are, at least 1: what rewards are divided by."""
    return problems.task_mask.sum(dim=1).clamp(min=1).float()


def choices(problems: Problems, state: FleetState) -> Choices:
    """What drones may do now, and what each task would cost each of them."""
    scale = problems.scale[:, None]
    cost = state.legs + _finite(problems.task_end / scale[..., None]) - state.to_end[..., None]
    fits = problems.demand[:, None, :] <= state.remaining[..., None]
    flown = state.travelled[..., None] + cost + _finite(problems.start_end / scale)[..., None]
    is_near = (cost < FAR / 2) & (flown <= (problems.max_distance / scale)[..., None])
    tasks = state.is_open[:, None, :] & fits & (state.slots > 0)[..., None] & is_near
    must = state.is_stalled[:, None] & tasks.any(dim=2)  # (B, N)
    return Choices(cost, torch.cat([tasks, ~must[..., None]], dim=2))


def step(
    problems: Problems, state: FleetState, options: Choices, actions: Tensor, *, step_cost: float = 0.0
) -> tuple[FleetState, StepOutcome]:
    """One decision of every drone.

    The team's reward is minus the marginal costs of the tasks taken, divided by scale and number of tasks, less
    ``step_cost`` while the episode lasts. Marginal costs add up to the fleet's travel, so the undiscounted return is
    exactly minus the travel; the division gives scenes of all sizes returns of about -1, so that none outweighs others.

    Args:
        problems: The fleets.
        state: Where their episodes stand.
        options: The `choices` in this state.
        actions: (B, N) int64, tasks, or M to idle; each one allowed.
        step_cost: What a step costs.
    """
    idle = problems.num_tasks
    claims = torch.nn.functional.one_hot(actions, idle + 1)[..., :idle].bool()  # (B, N, M)
    winner = torch.where(claims, options.cost, torch.inf).argmin(dim=1)  # (B, M), the first of equals
    named = actions.clamp(max=idle - 1)
    has_won = (winner.gather(1, named) == torch.arange(actions.shape[1])) & (actions < idle)  # (B, N)
    taken = torch.where(has_won, named, -1)
    paid = torch.where(has_won, options.cost.gather(2, named[..., None])[..., 0], 0.0)
    reward = -paid.sum(dim=1) / num_to_serve(problems) - torch.where(options.is_over, 0.0, step_cost)
    return _moved(problems, state, taken, has_won, paid), StepOutcome(taken, paid, reward)


def _moved(problems: Problems, state: FleetState, taken: Tensor, has_won: Tensor, paid: Tensor) -> FleetState:
    """The state after drones have taken tasks."""
    batch = torch.arange(len(taken))[:, None]
    task = taken.clamp(min=0)
    scale = problems.scale[:, None]
    legs = _finite(problems.task_task[batch, problems.drone_class, task] / scale[..., None])  # (B, N, M)
    to_end = _finite(problems.task_end.gather(2, task[..., None])[..., 0] / scale)
    gone = torch.zeros_like(state.is_open, dtype=torch.int64).scatter_add(1, task, has_won.long()) > 0
    demand = problems.demand.gather(1, task)
    return FleetState(
        legs=torch.where(has_won[..., None], legs, state.legs),
        to_end=torch.where(has_won, to_end, state.to_end),
        is_open=state.is_open & ~gone,
        remaining=state.remaining - torch.where(has_won, demand, 0.0),
        slots=state.slots - has_won.float(),
        place=torch.where(has_won, taken, state.place),
        travelled=state.travelled + paid,
        is_stalled=~has_won.any(dim=1),
    )
