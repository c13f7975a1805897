"""Vectorised bundle refinement: local search on the bundles of many scenes at once.

It begins at bundles as an allocator left them and only ever shortens the fleet's travel: in every round each scene makes
the one move that saves most, of moving a task elsewhere, exchanging two tasks, and exchanging the ends of two routes; all
such moves of all scenes are weighed in one go. It stops at a local optimum or after `MOVES_A_TASK` moves a task. Plain
local search, then, with nothing learned in it: reports must say whether bundles were refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from flockopt.bundles.request import RouteTuple
from flockopt.scene import Scene
from flockopt.travel import Travel
from learned.teacher.problems import Problems

__all__ = ["MOVES_A_TASK", "refine"]

#: Most moves a scene makes, for each of its tasks.
MOVES_A_TASK = 1.0

#: A move must save more than this share of the scene's scale; what float32 cannot tell from nothing is no saving.
LEAST_SAVING = 1e-4

#: What stands for the length of a way where there is none, metres: no move that saves metres can afford it.
NO_WAY_M = 1e7

#: How many pairs of gaps are weighed at a time; bounds the memory that large scenes take.
MOST_PAIRS = 4_000_000


def refine(scenes: Sequence[Scene], travels: Sequence[Travel], routes: Sequence[Sequence[Sequence[int]]]) -> list[RouteTuple]:
    """Bundles with less travel; tasks that were not served stay so, and capacities and longest routes are kept.

    Args:
        scenes: At least one.
        travels: The travel of each.
        routes: Of each scene, N bundles that keep its capacities.
    """
    problems = _finite(Problems.of(scenes, travels))
    if problems.num_tasks == 0:
        return [((),) * scene.num_drones for scene in scenes]
    owner = torch.full((len(scenes), problems.num_tasks), problems.num_drones)
    rank = torch.zeros(owner.shape)
    for row, fleet in enumerate(routes):
        for drone, route in enumerate(fleet):
            owner[row, list(route)] = drone
            rank[row, list(route)] = torch.arange(float(len(route)))
    gaps = problems.num_drones * (_longest(problems) + 1)
    at_a_time = max(MOST_PAIRS // gaps**2, 1)
    for begin in range(0, len(scenes), at_a_time):
        part = slice(begin, begin + at_a_time)
        owner[part], rank[part] = _descend(problems[part], owner[part], rank[part])
    return [_as_routes(scene, *fleet) for scene, *fleet in zip(scenes, owner.tolist(), rank.tolist(), strict=True)]


def _finite(problems: Problems) -> Problems:
    """The problems with ways of `NO_WAY_M` where there are none, so that differences are numbers."""
    lengths = {
        name: getattr(problems, name).clamp(max=NO_WAY_M) for name in ("start_task", "task_task", "task_end", "start_end")
    }
    return problems.replace(**lengths)


def _as_routes(scene: Scene, owner: list[int], rank: list[float]) -> RouteTuple:
    bundles: list[list[int]] = [[] for _ in range(scene.num_drones)]
    for task in sorted(range(scene.num_tasks), key=rank.__getitem__):
        if owner[task] < scene.num_drones:
            bundles[owner[task]].append(task)
    return tuple(tuple(bundle) for bundle in bundles)


def _longest(problems: Problems) -> int:
    """How many tasks a route can have at most."""
    least_demand = torch.where(problems.task_mask, problems.demand, torch.inf).amin().clamp(min=1.0)
    return max(min(problems.num_tasks, int(problems.capacity.max() / least_demand)), 1)


def _descend(problems: Problems, owner: Tensor, rank: Tensor) -> tuple[Tensor, Tensor]:
    """Owners and ranks (B, M) at a local optimum, or after as many moves as are granted."""
    owner, rank = owner.clone(), rank.clone()
    rows = torch.arange(len(problems))
    longest = _longest(problems)
    with torch.inference_mode():
        for _ in range(int(MOVES_A_TASK * problems.num_tasks)):
            fleet = _Fleet(problems[rows], owner[rows], rank[rows], longest)
            saving, moved_owner, moved_rank = _best_move(fleet)
            improved = saving > LEAST_SAVING * problems.scale[rows]
            rows = rows[improved]
            if not len(rows):
                break
            owner[rows], rank[rows] = moved_owner[improved], moved_rank[improved]
    return owner, rank


@dataclass(frozen=True, eq=False)
class _Fleet:
    """Bundles of a batch of scenes, and the legs around every gap; a route of K tasks has K + 1 gaps.

    Attributes:
        problems: The scenes.
        owner: (B, M) int64, which drone serves a task; N where none does.
        order: (B, M) numbers that rise along each route.
        longest: L, how many tasks a route can have at most.
    """

    problems: Problems
    owner: Tensor
    order: Tensor
    longest: int

    @cached_property
    def rank(self) -> Tensor:
        """(B, M) int64, how many tasks come before one in its bundle."""
        is_shared = self.owner[:, :, None] == self.owner[:, None, :]
        return (is_shared & (self.order[:, None, :] < self.order[:, :, None])).sum(dim=2)

    @cached_property
    def task_after(self) -> Tensor:
        """(B, N, L + 1) int64, the task behind each gap; M where there is none."""
        count, num_drones, num_tasks = len(self.owner), self.problems.num_drones, self.problems.num_tasks
        width = self.longest + 1
        slots = torch.full((count, num_drones * width + 1), num_tasks)
        place = torch.where(self.owner < num_drones, self.owner * width + self.rank, num_drones * width)
        slots.scatter_(1, place, torch.arange(num_tasks).expand(count, -1))
        return slots[:, :-1].view(count, num_drones, width)

    @cached_property
    def task_before(self) -> Tensor:
        """(B, N, L + 1) int64, the task ahead of each gap; M where that is the start."""
        none = torch.full_like(self.task_after[..., :1], self.problems.num_tasks)
        return torch.cat([none, self.task_after[..., :-1]], dim=2)

    @cached_property
    def size(self) -> Tensor:
        """(B, N) int64, tasks in each bundle."""
        return (self.task_after < self.problems.num_tasks).sum(dim=2)

    @cached_property
    def is_gap(self) -> Tensor:
        """(B, N, L + 1) bool, whether a route has this gap."""
        return torch.arange(self.longest + 1) <= self.size[..., None]

    @cached_property
    def legs_in(self) -> Tensor:
        """(B, N, L + 1, M) m, from the place ahead of a gap to every task."""
        return torch.where(
            (self.task_before == self.problems.num_tasks)[..., None],
            self.problems.start_task[:, :, None, :],
            self._between(self.task_before),
        )

    @cached_property
    def legs_out(self) -> Tensor:
        """(B, N, L + 1, M) m, from every task to the place behind a gap; the way to the drone's end behind the last."""
        is_last = (self.task_after == self.problems.num_tasks)[..., None]
        return torch.where(is_last, self.problems.task_end[:, :, None, :], self._between(self.task_after))

    def _between(self, task: Tensor) -> Tensor:
        """(B, N, L + 1, M) m, between tasks and all others, as the drone's class flies."""
        batch = torch.arange(len(task))[:, None, None]
        known = task.clamp(max=self.problems.num_tasks - 1)
        return self.problems.task_task[batch, self.problems.drone_class[..., None], known]

    @cached_property
    def end_legs(self) -> Tensor:
        """(B, N, L + 1) m, from the place ahead of a gap to the drone's end."""
        before = self.task_before
        from_task = self.problems.task_end.gather(2, before.clamp(max=self.problems.num_tasks - 1))
        return torch.where(before == self.problems.num_tasks, self.problems.start_end[..., None], from_task)

    @cached_property
    def leg_across(self) -> Tensor:
        """(B, N, L + 1) m, the leg that a gap lies in; 0 where there is no such gap."""
        after = self.task_after
        to_task = self.legs_in.gather(3, after.clamp(max=self.problems.num_tasks - 1)[..., None])[..., 0]
        leg = torch.where(after == self.problems.num_tasks, self.end_legs, to_task)
        return torch.where(self.is_gap, leg, 0.0)

    @cached_property
    def length(self) -> Tensor:
        """(B, N) m, of the routes."""
        return self.leg_across.sum(dim=2)

    @cached_property
    def load_ahead(self) -> Tensor:
        """(B, N, L + 1) demand of the tasks ahead of each gap."""
        none = torch.zeros_like(self.problems.demand[:, :1])
        demand = torch.cat([self.problems.demand, none], dim=1)[:, None].expand(-1, self.problems.num_drones, -1)
        return demand.gather(2, self.task_before).cumsum(dim=2)

    @property
    def load(self) -> Tensor:
        """(B, N) demand in each bundle."""
        return self.load_ahead[..., -1]

    @cached_property
    def has_room(self) -> Tensor:
        """(B, N) m, how much longer each route may get."""
        return self.problems.max_distance - self.length

    def at_tasks(self, values: Tensor, shift: int = 0) -> Tensor:
        """(B, M, ...): of (B, N, L + 1, ...) values those at the gap ahead of each task, or ``shift`` gaps later."""
        owner = self.owner.clamp(max=self.problems.num_drones - 1)
        rank = (self.rank + shift).clamp(max=self.longest)
        return values[torch.arange(len(values))[:, None], owner, rank]


Move = tuple[Tensor, Tensor, Tensor]


def _best_move(fleet: _Fleet) -> Move:
    """(B,) m saved by each scene's best move, and the owners and orders (B, M) after it."""
    saving, owner, order = _best_transfer(fleet)
    for other in (_best_exchange(fleet), _best_tail_exchange(fleet)):
        better = other[0] > saving
        saving = torch.where(better, other[0], saving)
        owner = torch.where(better[:, None], other[1], owner)
        order = torch.where(better[:, None], other[2], order)
    return saving, owner, order


def _best_transfer(fleet: _Fleet) -> Move:
    """Move one task to another gap, of its own route or another."""
    problems = fleet.problems
    count, num_drones, num_tasks = len(problems), problems.num_drones, problems.num_tasks
    is_served = fleet.owner < num_drones  # (B, M)
    freed = _detour(fleet) * is_served  # (B, M) m, what its removal saves
    added = fleet.legs_in + fleet.legs_out - fleet.leg_across[..., None]  # (B, N, L + 1, M)
    is_own = fleet.owner[:, None, :] == torch.arange(num_drones)[:, None]  # (B, N, M)
    fits = is_own | (fleet.load[..., None] + problems.demand[:, None, :] <= problems.capacity[..., None])
    longer = added - (freed[:, None] * is_own)[:, :, None]
    beside = (fleet.task_after[..., None] == torch.arange(num_tasks)) | (
        fleet.task_before[..., None] == torch.arange(num_tasks)
    )
    may = (
        fleet.is_gap[..., None]
        & fits[:, :, None]
        & ~beside
        & is_served[:, None, None]
        & (longer <= fleet.has_room[:, :, None, None])
    )
    saved = torch.where(may, freed[:, None, None] - added, -torch.inf)
    saving, best = saved.flatten(1).max(dim=1)
    gap, task = best // num_tasks, best % num_tasks
    rows = torch.arange(count)
    owner, order = fleet.owner.clone(), fleet.rank.float()
    owner[rows, task] = gap // (fleet.longest + 1)
    order[rows, task] = gap % (fleet.longest + 1) - 0.5
    return saving, owner, order


def _detour(fleet: _Fleet) -> Tensor:
    """(B, M) m, what each task adds to its route."""
    legs = fleet.at_tasks(fleet.leg_across) + fleet.at_tasks(fleet.leg_across, 1)
    after = fleet.at_tasks(fleet.task_after, 1)
    num_tasks = fleet.problems.num_tasks
    across = fleet.at_tasks(fleet.legs_in).gather(2, after.clamp(max=num_tasks - 1)[..., None])[..., 0]
    to_end = fleet.at_tasks(fleet.end_legs)
    return legs - torch.where(after == num_tasks, to_end, across)


def _best_exchange(fleet: _Fleet) -> Move:
    """Let two tasks change places."""
    problems = fleet.problems
    num_tasks = problems.num_tasks
    legs = fleet.at_tasks(fleet.leg_across) + fleet.at_tasks(fleet.leg_across, 1)
    # (B, M, M) m: how much longer the route of a task gets when another stands in its place.
    longer = fleet.at_tasks(fleet.legs_in) + fleet.at_tasks(fleet.legs_out, 1) - legs[..., None]
    # Entry (j, k) and its mirror image (k, j) are the two halves of one exchange; neighbours in a route share a leg, which
    # would count twice, and are left out.
    total = longer + longer.mT
    is_shared = fleet.owner[:, :, None] == fleet.owner[:, None, :]
    is_served = fleet.owner < problems.num_drones
    more = problems.demand[:, None, :] - problems.demand[:, :, None]  # (B, M, M) demand that comes into a task's bundle
    spare, room = (_of_owner(fleet, values)[..., None] for values in (problems.capacity - fleet.load, fleet.has_room))
    fits = is_shared | ((more <= spare) & (longer <= room))
    near = is_shared & ((fleet.rank[:, :, None] - fleet.rank[:, None, :]).abs() <= 1)
    may = (
        fits
        & fits.mT
        & ~near
        & (total <= torch.where(is_shared, room, torch.inf))
        & (is_served[:, :, None] & is_served[:, None, :])
    )
    saving, best = torch.where(may, -total, -torch.inf).flatten(1).max(dim=1)
    one, other = best // num_tasks, best % num_tasks
    return saving, _swapped(fleet.owner, one, other), _swapped(fleet.rank.float(), one, other)


def _of_owner(fleet: _Fleet, values: Tensor) -> Tensor:
    """(B, M): of (B, N) values those of each task's drone."""
    return values.gather(1, fleet.owner.clamp(max=fleet.problems.num_drones - 1))


def _swapped(values: Tensor, one: Tensor, other: Tensor) -> Tensor:
    rows = torch.arange(len(values))
    result = values.clone()
    result[rows, one], result[rows, other] = values[rows, other], values[rows, one]
    return result


def _best_tail_exchange(fleet: _Fleet) -> Move:
    """Let two routes of one class of drones exchange all that comes after a gap of each."""
    problems = fleet.problems
    num_drones, width = problems.num_drones, fleet.longest + 1
    drone = torch.arange(num_drones).repeat_interleave(width)  # (G,) of the gaps in a row
    length = _length_with_tail(fleet)  # (B, G, G) m, of the route with the first gap, going on behind the second
    saved = fleet.length[:, drone, None] + fleet.length[:, None, drone] - length - length.mT
    ahead = fleet.load_ahead.flatten(1)  # (B, G)
    load = ahead[:, :, None] + (fleet.load[:, drone] - ahead)[:, None, :]
    fits = (load <= problems.capacity[:, drone, None]) & (length <= problems.max_distance[:, drone, None])
    alike = problems.drone_class[:, drone, None] == problems.drone_class[:, None, drone]
    is_gap = fleet.is_gap.flatten(1)
    may = fits & fits.mT & alike & (drone[:, None] < drone) & is_gap[:, :, None] & is_gap[:, None, :]
    saving, best = torch.where(may, saved, -torch.inf).flatten(1).max(dim=1)
    one, other = best // drone.numel(), best % drone.numel()
    owner, order = fleet.owner.clone(), fleet.rank.float()
    for here, there in ((one, other), (other, one)):
        is_moved = (fleet.owner == drone[here][:, None]) & (fleet.rank >= (here % width)[:, None])
        owner = torch.where(is_moved, drone[there][:, None], owner)
        order = torch.where(is_moved, fleet.rank + (there % width - here % width)[:, None].float(), order)
    return saving, owner, order


def _length_with_tail(fleet: _Fleet) -> Tensor:
    """(B, G, G) m: of every route up to one gap and on with what comes behind another, to its own drone's end."""
    problems = fleet.problems
    num_drones, num_tasks, width = problems.num_drones, problems.num_tasks, fleet.longest + 1
    # Prefix sums along each route give the way to any gap and the way behind it, so that all pairs cost one addition each.
    walked = (fleet.leg_across.cumsum(dim=2) - fleet.leg_across).flatten(1)  # (B, G) m, from the start to a gap
    to_end = torch.where(fleet.is_gap, fleet.end_legs, 0.0).gather(2, fleet.size[..., None])[..., 0]  # (B, N) the last leg
    behind = (fleet.length - to_end)[..., None] - (fleet.leg_across.cumsum(dim=2))  # (B, N, L + 1) m, between the tasks behind
    head = fleet.task_after.flatten(1)  # (B, G), M where nothing is behind
    last = fleet.task_before.gather(2, fleet.size[..., None])[..., 0]  # (B, N) the last task
    index = head.clamp(max=num_tasks - 1)[:, None].expand(-1, num_drones * width, -1)
    join = fleet.legs_in.flatten(1, 2).gather(2, index)  # (B, G, G) m
    drone = torch.arange(num_drones).repeat_interleave(width)
    own_end = problems.task_end.gather(2, last.clamp(max=num_tasks - 1)[:, None].expand(-1, num_drones, -1))  # (B, N, N) m
    tail = join + behind.flatten(1)[:, None] + own_end[:, drone][:, :, drone]
    nothing = (head == num_tasks)[:, None]
    return walked[..., None] + torch.where(nothing, fleet.end_legs.flatten(1)[..., None], tail)
