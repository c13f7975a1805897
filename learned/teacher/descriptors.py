"""What policies are told of a state: numbers that depend on travel only, in units of the problem's scale.

All of it follows from what drones announce (where their routes end, what they can still carry) and from the travel
matrix, so it knows of obstacles, does not change when the scene is turned or relabelled, and is defined for any number of
drones and tasks. A drone's rival for a task is another drone that may take it; a task's neighbours are the other open
tasks nearest to it. Lengths and counts go through asinh, linear near zero and logarithmic far away.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from learned.teacher.environment import AT_START, Choices, FleetState
from learned.teacher.problems import Problems

__all__ = ["DRONE_FEATURES", "PAIR_FEATURES", "Observation", "observe"]

#: What is told of a drone and a task, in this order.
PAIR_FEATURES = (
    "marginal cost", "cost above the drone's cheapest task", "cost above the cheapest rival's", "cost above the second rival's",
    "cheapest rival's cost", "leg to the nearest neighbour", "leg to the second neighbour", "cost above the first leg",
    "drones that are cheaper", "tasks that are cheaper", "demand per capacity left", "whether no drone is cheaper",
    "cheapest rival's cost above its own cheapest task", "tasks that are cheaper to it", "its capacity left",
    "nearest neighbour's cost to the drone", "to the cheapest drone", "that cost above its cheapest rival's",
    "second neighbour's cost to the drone", "to the cheapest drone", "that cost above its cheapest rival's",
)  # fmt: skip

#: What is told of a drone, in this order.
DRONE_FEATURES = (
    "cost of its cheapest task", "cost of its second cheapest task", "mean cost of its tasks", "capacity left",
    "capacity left per open demand", "the fleet's spare capacity per open demand", "open tasks per drone that may take one",
    "open tasks", "tasks it is the cheapest drone for", "whether it has no task yet", "whether nobody took a task last",
)  # fmt: skip

#: What a missing rival, neighbour or task counts as, in units of the scale; no cost counts as more.
MISSING = 20.0


@dataclass(frozen=True, eq=False)
class Observation:
    """What is seen of a batch of states.

    Of the tasks, those that are taken are left out as far as the batch allows: K is the most that are open in any of its
    states, and in the others closed ones fill up.

    Attributes:
        pair: (B, N, K, P) of each drone and task, see `PAIR_FEATURES`.
        drone: (B, N, D) of each drone, see `DRONE_FEATURES`.
        last: (B, N, P) of each drone and the task it took in the step before; of any task where it took none.
        has_taken: (B, N) bool, whether it took one.
        allowed: (B, N, K + 1) bool, idling last, see `environment.Choices`.
        is_open: (B, K) bool.
        drone_mask: (B, N) bool.
        tasks: (B, K) int64, which tasks these are.
    """

    pair: Tensor
    drone: Tensor
    last: Tensor
    has_taken: Tensor
    allowed: Tensor
    is_open: Tensor
    drone_mask: Tensor
    tasks: Tensor

    def __getitem__(self, rows: Tensor | slice) -> Observation:
        return Observation(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class _Prices:
    """What tasks cost drones, (B, N, M) each.

    Attributes:
        own: Marginal cost; `MISSING` where the drone may not take the task.
        above_own: How much more than the drone's cheapest task.
        rank: How many tasks are cheaper to the drone.
        rival: The cheapest rival's cost.
        second_rival: The second cheapest rival's.
        rival_index: int64, the cheapest rival; any drone where there is none.
    """

    own: Tensor
    above_own: Tensor
    rank: Tensor
    rival: Tensor
    second_rival: Tensor
    rival_index: Tensor


def observe(problems: Problems, state: FleetState, options: Choices, last_task: Tensor) -> Observation:
    """The descriptors of a batch of states.

    Args:
        problems: The fleets.
        state: Where their episodes stand.
        options: The `environment.choices` in this state.
        last_task: (B, N) int64, the task that each drone took in the step before, or -1.
    """
    own = torch.where(options.allowed[..., :-1], options.cost.clamp(max=MISSING), MISSING)
    capacity = torch.minimum(state.remaining, state.slots)
    prices = _prices(own)
    pair = torch.stack(_pair_features(problems, state, options.cost.clamp(max=MISSING), capacity, prices), dim=3)
    drone = torch.stack(_drone_features(problems, state, capacity, prices), dim=2)
    num_kept = max(int(state.is_open.sum(dim=1).max()), 1)
    tasks = state.is_open.byte().sort(dim=1, descending=True, stable=True).indices[:, :num_kept]  # (B, K)
    columns = torch.cat([tasks, torch.full_like(tasks[:, :1], problems.num_tasks)], dim=1)
    return Observation(
        pair=_columns(pair, tasks),
        drone=drone,
        last=pair.gather(2, last_task.clamp(min=0)[..., None, None].expand(-1, -1, 1, pair.shape[3]))[:, :, 0],
        has_taken=last_task >= 0,
        allowed=_columns(options.allowed[..., None], columns)[..., 0],
        is_open=state.is_open.gather(1, tasks),
        drone_mask=problems.drone_mask,
        tasks=tasks,
    )


def _columns(values: Tensor, tasks: Tensor) -> Tensor:
    """(B, N, K, F): the tasks' columns of (B, N, M, F) values."""
    return values.gather(2, tasks[:, None, :, None].expand(-1, values.shape[1], -1, values.shape[3]))


def _prices(own: Tensor) -> _Prices:
    num_drones = own.shape[1]
    # the three cheapest drones of a task hold the two cheapest rivals of every drone, whether it is one of the three or not
    least = _with_missing(own, dim=1, extra=3).topk(3, dim=1, largest=False)  # (B, 3, M)
    first, second, third = least.values.unbind(dim=1)
    is_first = torch.arange(num_drones)[:, None] == least.indices[:, :1]  # (B, N, M)
    is_second = torch.arange(num_drones)[:, None] == least.indices[:, 1:2]
    return _Prices(
        own=own,
        above_own=own - own.amin(dim=2, keepdim=True),
        rank=(own[:, :, None, :] < own[..., None]).sum(dim=3).float(),
        rival=torch.where(is_first, second[:, None], first[:, None]),
        second_rival=torch.where(is_first | is_second, third[:, None], second[:, None]),
        rival_index=torch.where(is_first, least.indices[:, 1:2], least.indices[:, :1]).clamp(max=num_drones - 1),
    )


def _with_missing(values: Tensor, dim: int, extra: int) -> Tensor:
    """Values with ``extra`` missing ones appended along an axis, so that there are always enough to choose from."""
    shape = list(values.shape)
    shape[dim] = extra
    return torch.cat([values, torch.full(shape, MISSING)], dim=dim)


def _pair_features(problems: Problems, state: FleetState, cost: Tensor, capacity: Tensor, prices: _Prices) -> list[Tensor]:
    """(B, N, M) each, in the order of `PAIR_FEATURES`."""
    own = prices.own
    legs, neighbours = _neighbours(problems, state)  # (B, N, M, 2) both
    cheapest = own.amin(dim=1, keepdim=True)  # (B, 1, M)
    told = [
        cost.asinh(),
        (cost - own.amin(dim=2, keepdim=True)).asinh(),
        (cost - prices.rival).asinh(),
        (cost - prices.second_rival).asinh(),
        prices.rival.asinh(),
        legs[..., 0].asinh(),
        legs[..., 1].asinh(),
        (cost - legs[..., 0]).asinh(),
        (own[:, None] < own[:, :, None]).sum(dim=2).float().asinh(),
        prices.rank.asinh(),
        (problems.demand[:, None, :] / capacity[..., None].clamp(min=1.0)).clamp(max=2.0),
        (own == cheapest).float(),
    ]
    has_rival = prices.rival < MISSING
    of_rival = (prices.above_own, prices.rank, capacity[..., None].expand_as(own))
    told += [torch.where(has_rival, values.gather(1, prices.rival_index), 0.0).asinh() for values in of_rival]
    of_neighbour = ((own, MISSING), (cheapest.expand_as(own), MISSING), (own - prices.rival, 0.0))
    for k in range(2):
        has_neighbour = legs[..., k] < MISSING
        told += [
            torch.where(has_neighbour, values.gather(2, neighbours[..., k]), missing).asinh()
            for values, missing in of_neighbour
        ]
    return told


def _neighbours(problems: Problems, state: FleetState) -> tuple[Tensor, Tensor]:
    """(B, N, M, 2) twice: the legs from each task to its two nearest open tasks, as a drone's class flies, and which they are.

    Where there is none the leg is `MISSING`, and the task any.
    """
    between = problems.task_task / problems.scale[:, None, None, None]  # (B, C, M, M)
    hidden = ~state.is_open[:, None, None, :] | torch.eye(problems.num_tasks, dtype=torch.bool)
    between = torch.where(hidden, MISSING, between.clamp(max=MISSING))
    nearest = _with_missing(between, dim=3, extra=2).topk(2, dim=3, largest=False)
    batch = torch.arange(len(problems))[:, None]
    which = nearest.indices.clamp(max=problems.num_tasks - 1)
    return nearest.values[batch, problems.drone_class], which[batch, problems.drone_class]


def _drone_features(problems: Problems, state: FleetState, capacity: Tensor, prices: _Prices) -> list[Tensor]:
    """(B, N) each, in the order of `DRONE_FEATURES`."""
    own = prices.own
    is_able = own < MISSING
    num_able = is_able.any(dim=2).sum(dim=1, keepdim=True).clamp(min=1)  # (B, 1)
    num_open = state.is_open.sum(dim=1, keepdim=True).float()
    open_demand = (problems.demand * state.is_open).sum(dim=1, keepdim=True)
    spare = (capacity * problems.drone_mask).sum(dim=1, keepdim=True) - open_demand
    least = _with_missing(own, dim=2, extra=2).topk(2, dim=2, largest=False).values  # (B, N, 2)
    of_fleet = [
        (spare / open_demand.clamp(min=1.0)).clamp(max=5.0).asinh(),
        (num_open / num_able).asinh(),
        num_open.asinh(),
        state.is_stalled[:, None].float(),
    ]
    spare_share, open_per_drone, num_open, is_stalled = (values.expand_as(capacity) for values in of_fleet)
    return [
        least[..., 0].asinh(),
        least[..., 1].asinh(),
        ((own * is_able).sum(dim=2) / is_able.sum(dim=2).clamp(min=1)).asinh(),
        capacity.asinh(),
        (capacity / open_demand.clamp(min=1.0)).clamp(max=2.0),
        spare_share,
        open_per_drone,
        num_open,
        ((prices.own <= prices.rival) & is_able).sum(dim=2).float().asinh(),
        (state.place == AT_START).float(),
        is_stalled,
    ]
