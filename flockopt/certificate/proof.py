"""Lower bounds recomputed from their proofs, by code that shares nothing with what found them.

A proof is a kind and a vector (docs/certificate.md). Whatever numbers the vector holds, the value computed here
is below the travel of every feasible allocation: a wrong vector proves less, never something false.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, INTEGERS_1, INTEGERS_2, compiled_for
from flockopt.bundles import Bound
from flockopt.certificate.optimum import Offers, least_travel
from flockopt.errors import PlanError
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["KINDS", "recompute_bound"]

#: Tasks in an ng-neighbourhood, itself included: part of what the kind ``ng-route`` means.
NG_NEIGHBOURS = 8

#: A route may be longer than ``max_distance`` by this share: as much as the clause that judges it lets pass, and more.
LENGTH_TOLERANCE = 1e-5


def recompute_bound(scene: Scene, travel: Travel, proof: Bound) -> float:
    """The bound that a proof proves, metres; ``proof.value`` is not believed, and looked at by the kind ``optimum`` only.

    Raises:
        PlanError: If the kind is unknown, the vector has the wrong length or entries that are not finite, or there is too
            much to recheck.
    """
    if proof.kind not in KINDS:
        raise PlanError("kind", f"is {proof.kind!r}", f"must be one of {', '.join(KINDS)}", "prove the bound anew")
    evaluate, length = KINDS[proof.kind]
    dual = np.asarray(proof.dual, dtype=np.float64)
    wanted = length(scene)
    if dual.shape != (wanted,):
        raise PlanError("dual", f"has shape {dual.shape}", f"must have shape ({wanted},)", "prove the bound anew")
    if not np.isfinite(dual).all():
        raise PlanError("dual", "holds a NaN or an infinity", "must be finite", "prove the bound anew")
    return evaluate(scene, travel, np.maximum(dual, 0.0), proof.value) if scene.num_tasks else 0.0


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


def _ng_route(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    """Prices (M,) of the tasks, plus what each drone makes of them on its cheapest ng-route."""
    return float(dual.sum()) + sum(offer.least for offer in _offers(scene, travel, dual))


def _optimum(scene: Scene, travel: Travel, dual: FloatArray, claim: float) -> float:
    """The claim itself where no allocation of routes that the prices (M,) leave over is below it."""
    return least_travel(list(_offers(scene, travel, dual)), dual, scene.demands.astype(np.int64), claim)


def _offers(scene: Scene, travel: Travel, dual: FloatArray) -> Iterator[Offers]:
    """What each drone can do under prices (M,)."""
    demands = scene.demands.astype(np.int64)
    loads = np.minimum(scene.capacities, scene.demands.sum()).astype(np.int64)
    known: dict[tuple[int, bytes], FloatArray] = {}  # drones with one matrix and one end share their routes
    for index, drone in enumerate(scene.drones):
        kind, ends = int(travel.drone_class[index]), np.ascontiguousarray(travel.task_end[index])
        between, key = np.ascontiguousarray(travel.task_task[kind]), (kind, ends.tobytes())
        if key not in known:
            known[key] = _cheapest_rests(between, ends, dual, demands, int(loads.max()), *_neighbours(between))
        longest = np.inf if drone.max_distance is None else drone.max_distance * (1.0 + LENGTH_TOLERANCE)
        starts, idle = np.ascontiguousarray(travel.start_task[index]), float(travel.start_end[index])
        yield Offers(starts, between, ends, known[key], int(loads[index]), idle, longest)


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


@compiled_for(FLOATS_2, FLOATS_1, FLOATS_1, INTEGERS_1, types.int64, INTEGERS_2, INTEGERS_2)
def _cheapest_rests(
    between: FloatArray, ends: FloatArray, prices: FloatArray, demands: NDArray[np.int64], most: int,
    nearest: NDArray[np.int64], places: NDArray[np.int64],
) -> FloatArray:  # fmt: skip
    """Least priced cost of a route from its first task on, by load at most (most + 1) and first task (M,).

    A route may serve a task again once it has been to one that does not have it among its neighbours. Routes are
    grown from their end; a state is (load, first task, which of that task's neighbours it remembers as served),
    and only as many loads are kept as the largest demand looks back.
    """
    num_tasks, num_memories, depth = len(ends), 1 << nearest.shape[1], demands.max() + 1
    costs = np.full((depth, num_tasks, num_memories), np.inf)
    best = np.full((most + 1, num_tasks), np.inf)
    moved = np.zeros(num_memories, dtype=np.int64)
    for load in range(1, most + 1):
        layer = costs[load % depth]
        layer[:] = np.inf
        for task in range(num_tasks):
            if demands[task] == load:
                layer[task, 0] = ends[task] - prices[task]
            elif demands[task] < load:
                before = costs[(load - demands[task]) % depth]
                for follower in range(num_tasks):
                    step = between[task, follower] - prices[task]
                    if follower == task or not step < np.inf:
                        continue
                    forbidden = 0 if places[follower, task] < 0 else 1 << places[follower, task]
                    moved[0] = 0 if places[task, follower] < 0 else 1 << places[task, follower]
                    for memory in range(num_memories):
                        if memory:  # what the memory without its lowest member becomes, and that member's place here
                            lowest = 0
                            while not (memory >> lowest) & 1:
                                lowest += 1
                            place = places[task, nearest[follower, lowest]]
                            moved[memory] = moved[memory & (memory - 1)] | (0 if place < 0 else 1 << place)
                        if not memory & forbidden:
                            cost = before[follower, memory] + step
                            if cost < layer[task, moved[memory]]:
                                layer[task, moved[memory]] = cost
        for task in range(num_tasks):
            best[load, task] = min(best[load - 1, task], layer[task].min())
    return best


KINDS = {
    "rooted-forest": (_rooted_forest, lambda scene: 0),
    "held-karp-forest": (_held_karp_forest, lambda scene: scene.num_tasks + scene.num_drones),
    "ng-route": (_ng_route, lambda scene: scene.num_tasks),
    "optimum": (_optimum, lambda scene: scene.num_tasks),
}
