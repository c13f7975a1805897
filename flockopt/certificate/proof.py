"""Lower bounds recomputed from their proofs, by code that shares nothing with what found them.

A proof is a kind and a vector (docs/certificate.md). Whatever numbers the vector holds, the value computed here
is below the travel of every feasible allocation: a wrong vector proves less, never something false.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, INTEGERS_2, compiled_for
from flockopt.batches.deadline import heard
from flockopt.bundles import Bound
from flockopt.certificate.optimum import Offers, least_travel
from flockopt.errors import PlanError
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["KINDS", "recompute_bound"]

#: Tasks in an ng-neighbourhood, itself included: part of what the kind ``ng-route`` means.
NG_NEIGHBOURS = 8

#: Entries of a vector are within so many metres of 0: sums of larger ones lose to rounding what they are to prove.
MOST_PRICE_M = 1e8

#: Memories of ng-routes gone through, by load and two tasks, and kept, by load and task, at most: some minutes, and half
#: a gigabyte.
MOST_MEMORIES, MOST_KEPT = 10**11, 25_000_000

#: Memories beyond which an interrupt is to be heard meanwhile.
LONG_MEMORIES = 10**9

#: A route may be longer than ``max_distance`` by this share: as much as the clause that judges it lets pass, and more.
LENGTH_TOLERANCE = 1e-5


def recompute_bound(scene: Scene, travel: Travel, proof: Bound) -> float:
    """The bound that a proof proves, metres; ``proof.value`` is not believed, and looked at by the kind ``optimum`` only.

    Raises:
        PlanError: If the kind is unknown, the vector has the wrong length or entries that are no lengths, or there is too much
            to recheck.
    """
    if proof.kind not in KINDS:
        raise PlanError("kind", f"is {proof.kind!r}", f"must be one of {', '.join(KINDS)}", "prove the bound anew")
    kind = KINDS[proof.kind]
    dual = np.asarray(proof.dual, dtype=np.float64)
    wanted = kind.length(scene)
    if dual.shape != (wanted,):
        raise PlanError("dual", f"has shape {dual.shape}", f"must have shape ({wanted},)", "prove the bound anew")
    if not (np.abs(dual) <= MOST_PRICE_M).all():
        worst = dual[~(np.abs(dual) <= MOST_PRICE_M)][0]
        raise PlanError("dual", f"holds {worst:g}", f"must be within {MOST_PRICE_M:g} m of 0", "prove the bound anew")
    if not kind.is_signed:
        dual = np.maximum(dual, 0.0)
        if not scene.num_tasks:
            return 0.0
    return kind.evaluate(scene, travel, dual, proof.value)


def _rooted_forest(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    return _forest_weight(*_forest_costs(scene, travel))


def _held_karp_forest(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    """The forest under task prices (M,) and start prices (N,), less what a legal route would pay of them."""
    prices, start_prices = dual[: scene.num_tasks], dual[scene.num_tasks :]
    starts, between = _forest_costs(scene, travel, start_prices)
    weight = _forest_weight(starts + prices, between + prices[:, None] + prices[None, :])
    return weight - 2.0 * float(prices.sum()) - float(start_prices.sum())


def _forest_costs(scene: Scene, travel: Travel, start_prices: FloatArray | float = 0.0) -> tuple[FloatArray, FloatArray]:
    """(M,) from the cheapest start that can carry the task, and (M, M) between tasks for the cheapest class."""
    able = scene.capacities[:, None] >= scene.demands[None, :]
    priced = travel.start_task + np.broadcast_to(start_prices, scene.num_drones)[:, None]
    return np.where(able, priced, np.inf).min(axis=0), travel.task_task.min(axis=0)


def _forest_weight(roots: FloatArray, between: FloatArray) -> float:
    """Weight of the minimum spanning tree over the tasks and one super-root (Prim 1957); infinite if there is none."""
    nearest, weight = roots.copy(), 0.0
    outside = np.ones(len(roots), dtype=np.bool_)
    for _ in range(len(roots)):
        task = int(np.where(outside, nearest, np.inf).argmin())
        if not outside[task]:
            return np.inf  # only unreachable tasks are left
        weight += float(nearest[task])
        outside[task] = False
        nearest = np.minimum(nearest, between[task])
    return weight


def _two_ended_forest(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    """The forest and the ends' legs under prices of tasks' legs (M,) and drones' first legs (N,), less what is not paid."""
    prices, first_prices = dual[: scene.num_tasks], dual[scene.num_tasks :]
    able = scene.capacities[:, None] >= scene.demands[None, :]
    legs, together = np.full(2 * (scene.num_tasks,), np.inf), scene.demands[:, None] + scene.demands[None, :]
    for kind in np.unique(travel.drone_class):
        strongest = scene.capacities[travel.drone_class == kind].max()
        legs = np.minimum(legs, np.where(together <= strongest, travel.task_task[kind], np.inf))
    roots = np.where(able, travel.start_task + first_prices[:, None], np.inf).min(axis=0)
    weight = _forest_weight(roots + prices, legs + prices[:, None] + prices[None, :])
    idle = np.where(np.isfinite(travel.start_end), travel.start_end, 0.0)
    last = np.where(able, travel.task_end + prices[None, :], np.inf).min(axis=1, initial=np.inf)
    gains = np.sort(last - first_prices - idle)
    least = _least_drones(scene)
    if least > scene.num_drones:
        return np.inf
    flown = float(idle.sum() + gains[:least].sum() + np.minimum(gains[least:], 0.0).sum())
    return weight + flown - 2.0 * float(prices.sum())


def _least_drones(scene: Scene) -> int:
    """How many drones carry all tasks at least, the strongest first; more than there are where all of them cannot."""
    left, count = float(scene.demands.sum()), 0
    for capacity in sorted(scene.capacities, reverse=True):
        if left <= 0.0:
            return count
        left, count = left - float(capacity), count + 1
    return count if left <= 0.0 else count + 1


def _ng_route(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    """Prices (M,) of the tasks, plus what each drone makes of them on its cheapest ng-route."""
    return float(dual.sum()) + sum(offer.least for offer in _offers(scene, travel, dual))


def _ng_route_any_end(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    """Prices (M,) of tasks, and each drone's cheapest route, paid for where it ends by prices (M,), and cheapest last leg."""
    if not scene.num_tasks:
        return float(travel.start_end.sum())
    prices, turns = np.maximum(dual[: scene.num_tasks], 0.0), dual[scene.num_tasks :]
    demands = _in_units(scene, scene.demands)
    loads = _in_units(scene, np.minimum(scene.capacities, scene.demands.sum()))
    kinds, most = np.unique(travel.drone_class), int(loads.max())
    is_long, total = _work(len(kinds), demands, most) > LONG_MEMORIES, float(prices.sum())
    for kind in kinds:
        between = np.ascontiguousarray(travel.task_task[kind])
        rests = _rests(is_long, between, -turns, prices, demands, most, *_neighbours(between))
        for drone in np.flatnonzero(travel.drone_class == kind):
            flown = float((travel.start_task[drone] + rests[loads[drone]]).min())
            last = float((travel.task_end[drone] + turns).min())
            total += min(float(travel.start_end[drone]), flown + (last if np.isfinite(last) else 0.0))
    return total


def _optimum(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    """The claim itself where no allocation of routes that the prices (M,) leave over is below it."""
    return least_travel(list(_offers(scene, travel, dual)), dual, _in_units(scene, scene.demands), claim)


def _offers(scene: Scene, travel: Travel, dual: FloatArray) -> Iterator[Offers]:
    """What each drone can do under prices (M,)."""
    demands = _in_units(scene, scene.demands)
    loads = _in_units(scene, np.minimum(scene.capacities, scene.demands.sum()))
    lists = {(int(kind), row.tobytes()) for kind, row in zip(travel.drone_class, travel.task_end, strict=True)}
    is_long = _work(len(lists), demands, int(loads.max())) > LONG_MEMORIES
    near: dict[int, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}
    known: dict[tuple[int, bytes], FloatArray] = {}  # drones with one matrix and one end share their routes
    for index, drone in enumerate(scene.drones):
        kind, ends = int(travel.drone_class[index]), np.ascontiguousarray(travel.task_end[index])
        between, key = np.ascontiguousarray(travel.task_task[kind]), (kind, ends.tobytes())
        if kind not in near:
            near[kind] = _neighbours(between)
        if key not in known:
            known[key] = _rests(is_long, between, ends, dual, demands, int(loads.max()), *near[kind])
        longest = np.inf if drone.max_distance is None else drone.max_distance * (1.0 + LENGTH_TOLERANCE)
        starts, idle = np.ascontiguousarray(travel.start_task[index]), float(travel.start_end[index])
        yield Offers(starts, between, ends, known[key], int(loads[index]), idle, longest)


def _in_units(scene: Scene, loads: FloatArray) -> NDArray[np.int64]:
    """Whole units, rounded down, of the largest one that divides all demands: as many loads as there are to tell apart."""
    return loads.astype(np.int64) // np.gcd.reduce(scene.demands.astype(np.int64))


def _rests(is_long: bool, *given: Any) -> FloatArray:
    """`_cheapest_rests`, where they take long so that an interrupt is heard."""
    return heard(partial(_cheapest_rests, *given)) if is_long else _cheapest_rests(*given)


def _work(lists: int, demands: NDArray[np.int64], most: int) -> int:
    """How many memories lists of routes of loads up to ``most`` go through; a `PlanError` where they are too many."""
    num_tasks = len(demands)
    memories = 1 << min(NG_NEIGHBOURS - 1, num_tasks - 1)
    kept = max(most + 1, (int(demands.max()) + 1) * memories) * num_tasks
    work = lists * most * num_tasks**2 * memories
    if kept > MOST_KEPT or work > MOST_MEMORIES:
        rule = "a judge goes through so many loads of so many tasks only up to a limit (docs/certificate.md)"
        raise PlanError("kind", "has too many routes to recheck", rule, 'claim a bound of the kind "two-ended-forest"')
    return work


def _neighbours(between: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Per task its nearest other tasks, ties by index: (M, G - 1); and where each stands there, or -1: (M, M)."""
    num_tasks = len(between)
    others = between.copy()
    np.fill_diagonal(others, -np.inf)
    nearest = np.argsort(others, axis=1, kind="stable")[:, 1:NG_NEIGHBOURS].astype(np.int64)
    places = np.full((num_tasks, num_tasks), -1, dtype=np.int64)
    for place in range(nearest.shape[1]):
        places[np.arange(num_tasks), nearest[:, place]] = place
    return nearest, places


@compiled_for(FLOATS_2, FLOATS_1, FLOATS_1, INTEGERS_1, types.int64, INTEGERS_2, INTEGERS_2, nogil=True)
def _cheapest_rests(
    between: FloatArray, ends: FloatArray, prices: FloatArray, demands: NDArray[np.int64], most: int,
    nearest: NDArray[np.int64], places: NDArray[np.int64],
) -> FloatArray:  # fmt: skip
    """Least priced cost of a route from its first task on, by load at most (most + 1) and first task (M,).

    A route may serve a task again once it has been to one that does not have it among its neighbours. Routes are
    grown from their end; a state is (load, first task, which of that task's neighbours it remembers as served),
    and only as many loads are kept as the largest demand looks back. What remembers more than another that is no dearer is
    dropped: the other can go wherever it can.
    """
    num_tasks, width, depth = len(ends), nearest.shape[1], demands.max() + 1
    costs = np.full((depth, num_tasks, 1 << width), np.inf)
    kept, counts = np.zeros((depth, num_tasks, 1 << width), dtype=np.int16), np.zeros((depth, num_tasks), dtype=np.int64)
    best, least = np.full((most + 1, num_tasks), np.inf), np.empty(1 << width)
    for load in range(1, most + 1):
        for task in range(num_tasks):
            now, counts[load % depth, task] = costs[load % depth, task], 0
            now[:] = np.inf
            if demands[task] == load:
                now[0] = ends[task] - prices[task]
            elif demands[task] < load:
                back = (load - demands[task]) % depth
                for follower in range(num_tasks):
                    step = between[task, follower] - prices[task]
                    if follower == task or not step < np.inf:
                        continue
                    for memory in kept[back, follower, : counts[back, follower]]:
                        if places[follower, task] >= 0 and memory >> places[follower, task] & 1:
                            continue
                        after = 0 if places[task, follower] < 0 else 1 << places[task, follower]
                        for bit in range(width):
                            if memory >> bit & 1 and places[task, nearest[follower, bit]] >= 0:
                                after |= 1 << places[task, nearest[follower, bit]]
                        now[after] = min(now[after], costs[back, follower, memory] + step)
            cheapest = now.min()
            best[load, task] = min(best[load - 1, task], cheapest)
            for memory in range(1 << width if cheapest < np.inf else 0):
                least[memory] = np.inf  # of all that remember less
                for bit in range(width):
                    if memory >> bit & 1:
                        less = memory ^ (1 << bit)
                        least[memory] = min(least[memory], least[less], now[less])
                if now[memory] < least[memory]:
                    kept[load % depth, task, counts[load % depth, task]] = memory
                    counts[load % depth, task] += 1
    return best


class Kind(NamedTuple):
    """How a kind of proof is rechecked."""

    evaluate: Callable[[Scene, Travel, FloatArray, float], float]  # from scene, travel, vector and claimed value
    length: Callable[[Scene], int]  # of the vector
    is_signed: bool = False  # entries below 0 are read as they are, and drones without tasks count in scenes without them


KINDS = {
    "rooted-forest": Kind(_rooted_forest, lambda scene: 0),
    "held-karp-forest": Kind(_held_karp_forest, lambda scene: scene.num_tasks + scene.num_drones),
    "two-ended-forest": Kind(_two_ended_forest, lambda scene: scene.num_tasks + scene.num_drones, is_signed=True),
    "ng-route": Kind(_ng_route, lambda scene: scene.num_tasks),
    "ng-route-any-end": Kind(_ng_route_any_end, lambda scene: 2 * scene.num_tasks, is_signed=True),
    "optimum": Kind(_optimum, lambda scene: scene.num_tasks),
}
