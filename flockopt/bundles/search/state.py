"""The state of the search: routes as circular linked lists, changed in constant time and undone exactly.

Node j < M is task j; node M + i stands for drone i and is both the start and the end of its route, so that an empty
route, an open end and an end point need no special case: the distance from node M + i is from the drone's start, the
distance to it is to the drone's end. Every change is written to a log, and undoing replays the log backwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_3, INNER, INTEGERS_1, compiled_lazily, record_of
from flockopt.records.arrays import FloatArray

__all__ = [
    "INDICES_1",
    "INDICES_2",
    "OPTIONS",
    "PROBLEM",
    "ROUTES",
    "IntArray",
    "Problem",
    "Routes",
    "adopt",
    "collect_waiting",
    "commit",
    "compiled",
    "empty_routes",
    "inner",
    "insertion_cost",
    "link",
    "random_index",
    "random_unit",
    "resize",
    "total_cost",
    "undo",
    "unlink",
]

#: Route of a task that no drone visits.
UNSERVED = 2**32 - 1

#: Slots of `Routes.counters`.
NUM_WAITING, NUM_WAITED, NUM_LOGGED, NUM_RESTING, RUIN, NUM_TORN = range(6)

#: Indices have no sign, so that numba does not look for negative ones at every access.
IntArray = NDArray[np.uint32]
INDICES_1, INDICES_2 = (types.Array(types.uint32, dimensions, "C") for dimensions in (1, 2))


#: Compiles a function of the search. Without numba's reference counts, which cost more than the work they guard
#: here, such a function cannot make an array: that nothing is allocated in the loop is checked at compile time.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
compiled = compiled_lazily(no_cfunc_wrapper=True, **OPTIONS)

#: The same for what only such functions call.
inner = compiled_lazily(**INNER, **OPTIONS)


class Problem(NamedTuple):
    """What the search may not change. Legs that cannot be flown have the finite length ``no_way``."""

    distance: FloatArray  # (C, M + N, M + N) m, per class of drone, from node to node
    drone_class: IntArray  # (N,)
    group: IntArray  # (N,) drones of one group are interchangeable
    members: IntArray  # (N,) drones sorted by group
    first_member: IntArray  # (groups,) slot of a group's first drone in `members`
    num_members: IntArray  # (groups,)
    near: IntArray  # (M, K) nearest tasks, nearest first
    near_groups: IntArray  # (M, G) groups whose drones start or end nearest
    remoteness: FloatArray  # (M,) m, from the nearest start
    demand: NDArray[np.int64]  # (M,)
    capacity: NDArray[np.int64]  # (N,)
    longest: FloatArray  # (N,) m, the longest route each drone may fly, with some slack
    no_way: float  # m
    penalty: float  # m, for every task not served


class Routes(NamedTuple):
    """A solution and its log."""

    after: IntArray  # (M + N,) next node
    before: IntArray  # (M + N,) previous node
    route: IntArray  # (M + N,) the drone whose route a node is on, or UNSERVED
    room: NDArray[np.int64]  # (N,) demand that still fits on board
    length: FloatArray  # (N,) m
    size: IntArray  # (N,) tasks on the route
    resting: IntArray  # (N,) drones without tasks, in the slots that `Problem.members` has for their group
    num_resting: IntArray  # (groups,)
    slot: IntArray  # (N,) where a resting drone stands in `resting`
    waiting: IntArray  # (M,) tasks not served
    waited: IntArray  # (M,) those that were not at the last commit
    ruined: NDArray[np.int64]  # (N,) number of the last ruin that took tasks from the route
    torn: IntArray  # (N,) the routes that the last ruin took tasks from
    log_task: IntArray  # (2 M,) tasks moved since the last commit
    log_previous: IntArray  # (2 M,) the node it was taken from behind, or UNSERVED where it was put in
    sort_key: FloatArray  # (M,) scratch of the recreate step
    counters: NDArray[np.int64]  # (6,) see NUM_WAITING and its neighbours
    random: NDArray[np.uint64]  # (1,) state of the generator


#: The two as compiled code knows them.
PROBLEM = record_of(
    Problem, FLOATS_3, *[INDICES_1] * 5, INDICES_2, INDICES_2, FLOATS_1, INTEGERS_1, INTEGERS_1, FLOATS_1, types.float64,
    types.float64,
)  # fmt: skip
ROUTES = record_of(
    Routes, *[INDICES_1] * 3, INTEGERS_1, FLOATS_1, *[INDICES_1] * 6, INTEGERS_1, *[INDICES_1] * 3, FLOATS_1, INTEGERS_1,
    types.Array(types.uint64, 1, "C"),
)  # fmt: skip


def empty_routes(problem: Problem, seed: int) -> Routes:
    """Routes without tasks: all of them wait."""
    num_drones, num_tasks = len(problem.capacity), len(problem.demand)
    nodes = np.arange(num_tasks + num_drones, dtype=np.uint32)
    drones = np.arange(num_drones, dtype=np.uint32)
    slot = np.empty(num_drones, dtype=np.uint32)
    slot[problem.members] = drones
    depots = nodes[num_tasks:]
    return Routes(
        after=nodes.copy(),
        before=nodes.copy(),
        route=np.concatenate([np.full(num_tasks, UNSERVED, dtype=np.uint32), drones]),
        room=problem.capacity.copy(),
        length=problem.distance[problem.drone_class, depots, depots],
        size=np.zeros(num_drones, dtype=np.uint32),
        resting=problem.members.copy(),
        num_resting=problem.num_members.copy(),
        slot=slot,
        waiting=nodes[:num_tasks].copy(),
        waited=nodes[:num_tasks].copy(),
        ruined=np.zeros(num_drones, dtype=np.int64),
        torn=np.empty(num_drones, dtype=np.uint32),
        log_task=np.empty(2 * num_tasks, dtype=np.uint32),
        log_previous=np.empty(2 * num_tasks, dtype=np.uint32),
        sort_key=np.empty(num_tasks),
        counters=np.array([num_tasks, num_tasks, 0, num_drones, 0, 0], dtype=np.int64),
        random=_seeded(seed),
    )


def _seeded(seed: int) -> NDArray[np.uint64]:
    """A generator state that differs in every bit between neighbouring seeds (splitmix64) and is never zero."""
    return np.random.SeedSequence(seed).generate_state(1, np.uint64) | np.uint64(1)


@inner
def _random_bits(random: NDArray[np.uint64]) -> np.uint64:
    """Next 64 random bits (xorshift64*; Vigna, 2016)."""
    x = random[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    random[0] = x
    return x * np.uint64(0x2545F4914F6CDD1D)


@compiled
def random_unit(random: NDArray[np.uint64]) -> float:
    """A random number in (0, 1]."""
    return (float(_random_bits(random) >> np.uint64(11)) + 1.0) * 1.1102230246251565e-16


@compiled
def random_index(random: NDArray[np.uint64], count: int) -> np.int64:
    """A random integer in [0, count), count < 2**31."""
    return np.int64(((_random_bits(random) >> np.uint64(33)) * np.uint64(count)) >> np.uint64(31))


@inner
def insertion_cost(problem: Problem, routes: Routes, task: int, previous: int) -> float:
    """What putting ``task`` behind node ``previous`` adds to its route, metres."""
    matrix = problem.distance[problem.drone_class[routes.route[previous]]]
    following = routes.after[previous]
    return matrix[previous, task] + matrix[task, following] - matrix[previous, following]


@inner
def resize(problem: Problem, routes: Routes, drone: int, more: int) -> None:
    """Note that the drone's route has ``more`` tasks than before, and whether it rests now."""
    size = routes.size[drone]
    routes.size[drone] = size + more
    group = problem.group[drone]
    if size == 0 and more > 0:
        routes.num_resting[group] -= 1
        routes.counters[NUM_RESTING] -= 1
        moved, slot = routes.resting[problem.first_member[group] + routes.num_resting[group]], routes.slot[drone]
        routes.resting[slot], routes.slot[moved] = moved, slot
    elif size > 0 and size + more == 0:
        slot = problem.first_member[group] + routes.num_resting[group]
        routes.resting[slot], routes.slot[drone] = drone, slot
        routes.num_resting[group] += 1
        routes.counters[NUM_RESTING] += 1


@inner
def _link(problem: Problem, routes: Routes, task: int, previous: int) -> float:
    cost = insertion_cost(problem, routes, task, previous)
    drone, following = routes.route[previous], routes.after[previous]
    routes.after[previous], routes.before[task] = task, previous
    routes.after[task], routes.before[following] = following, task
    routes.route[task] = drone
    routes.room[drone] -= problem.demand[task]
    routes.length[drone] += cost
    resize(problem, routes, drone, np.int64(1))
    return cost


@inner
def _unlink(problem: Problem, routes: Routes, task: int) -> float:
    drone, previous, following = routes.route[task], routes.before[task], routes.after[task]
    routes.after[previous], routes.before[following] = following, previous
    routes.route[task] = UNSERVED
    routes.room[drone] += problem.demand[task]
    resize(problem, routes, drone, np.int64(-1))
    cost = insertion_cost(problem, routes, task, np.int64(previous))
    routes.length[drone] -= cost
    return -cost


@inner
def link(problem: Problem, routes: Routes, task: int, previous: int) -> float:
    """Put an unserved task behind node ``previous``; returns the travel this adds, metres."""
    logged = routes.counters[NUM_LOGGED]
    routes.log_task[logged], routes.log_previous[logged] = task, UNSERVED
    routes.counters[NUM_LOGGED] = logged + 1
    return _link(problem, routes, task, previous)


@inner
def unlink(problem: Problem, routes: Routes, task: int) -> float:
    """Take a task off its route; returns the travel this adds (mostly negative), metres."""
    logged = routes.counters[NUM_LOGGED]
    routes.log_task[logged], routes.log_previous[logged] = task, routes.before[task]
    routes.counters[NUM_LOGGED] = logged + 1
    return _unlink(problem, routes, task)


@compiled
def commit(routes: Routes) -> None:
    """Keep the changes."""
    routes.counters[NUM_LOGGED] = 0
    routes.counters[NUM_WAITED] = routes.counters[NUM_WAITING]
    for place in range(routes.counters[NUM_WAITING]):
        routes.waited[place] = routes.waiting[place]


@compiled
def undo(problem: Problem, routes: Routes) -> None:
    """Take back the changes since the last commit, last one first."""
    for entry in range(routes.counters[NUM_LOGGED] - 1, -1, -1):
        task, previous = np.int64(routes.log_task[entry]), np.int64(routes.log_previous[entry])
        if previous == UNSERVED:
            _unlink(problem, routes, task)
        else:
            _link(problem, routes, task, previous)
    routes.counters[NUM_LOGGED] = 0
    routes.counters[NUM_WAITING] = routes.counters[NUM_WAITED]
    for place in range(routes.counters[NUM_WAITED]):
        routes.waiting[place] = routes.waited[place]


@compiled
def total_cost(problem: Problem, routes: Routes) -> float:
    """Travel of all drones plus the penalty of every unserved task, metres; sets every drone's length anew."""
    num_tasks = len(problem.demand)
    total = problem.penalty * routes.counters[NUM_WAITING]
    for drone in range(len(problem.capacity)):
        kind, node, length = problem.drone_class[drone], num_tasks + drone, 0.0
        while True:
            following = routes.after[node]
            length += problem.distance[kind, node, following]
            node = following
            if node >= num_tasks:
                break
        routes.length[drone] = length
        total += length
    return total


@compiled
def adopt(problem: Problem, routes: Routes, after: IntArray) -> None:
    """Make the routes those that the links ``after`` describe, for all drones; other tasks wait."""
    num_tasks = len(problem.demand)
    for task in range(num_tasks):
        if routes.route[task] != UNSERVED:
            _unlink(problem, routes, task)
    for drone in range(len(problem.capacity)):
        node = np.int64(num_tasks + drone)
        while after[node] < num_tasks:
            _link(problem, routes, np.int64(after[node]), node)
            node = np.int64(after[node])
    collect_waiting(problem, routes)
    commit(routes)


@inner
def collect_waiting(problem: Problem, routes: Routes) -> None:
    """Find the tasks that no drone serves."""
    waiting = 0
    for task in range(len(problem.demand)):
        if routes.route[task] == UNSERVED:
            routes.waiting[waiting] = task
            waiting += 1
    routes.counters[NUM_WAITING] = waiting
