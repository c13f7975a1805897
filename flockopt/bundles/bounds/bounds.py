"""Lower bounds on the fleet's travel, each with the vector that proves it.

``fast`` is a spanning forest with legs to the ends, ``tight`` the same under Held-Karp prices and, where that takes next to
no time, the Lagrangian of all ng-routes, or of ng-routes whose drones pay for any end; ``exact`` is the latter whatever they
take, the bound that a proof of optimality starts from. A bound holds for every allocation that serves all tasks within the
capacities, so it is claimed of feasible scenes; where a relaxation by itself shows that there is no such allocation (tasks cut
off from every start), its value is infinite, the least cost over nothing.
The value is what whoever recomputes it from the vector finds; at a deadline it is the best one proven by then.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flockopt.batches.deadline import NEVER, Deadline, OutOfTime
from flockopt.bundles import Bound
from flockopt.bundles.bounds import forest
from flockopt.bundles.bounds.ng_route import count_pairs
from flockopt.bundles.bounds.one_each import carries_one_at_most, match_one_each
from flockopt.bundles.bounds.polyak import FIRST_REACH, begin
from flockopt.bundles.bounds.pricing import (
    CLOSED_GAP,
    NEIGHBOURS,
    ascend,
    ascend_prices,
    drones_that_share,
    evaluate_any_end,
    group_drones,
    route_loads,
    travel_ceiling,
)
from flockopt.bundles.bundles import BOUND_EFFORTS
from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["first_prices", "forest_bound", "is_judged", "lower_bound", "ng_route_bound", "tight_bound"]

#: Spanning trees grown for the Held-Karp bound: within 0.1 % of its limit from 10 x 20 to 100 x 1000. Small ones take more
#: rounds, and are cheap: as many as have so many legs.
FOREST_ROUNDS, MOST_FOREST_ROUNDS, FOREST_LEGS = 60, 300, 200_000

#: Dynamic programs solved for the ng-route bound: within 0.05 % of its limit from 10 x 20 to 20 x 100.
NG_ROUNDS = 80

#: What the ng-routes of the bound ``tight`` may cost in all, at first and for each task, in units of about 10 ns, a task
#: costing more where there are more than so many; what a group of drones costs, whatever its routes. Less than a few rounds are
#: not worth their time.
TIGHT_COST, TIGHT_COST_A_TASK, MANY_TASKS, GROUP_COST, LEAST_NG_ROUNDS = 500_000, 5_000, 50, 1_500, 4

#: Prices are sketched first, on routes that remember fewer tasks: how many are in a neighbourhood then, what that costs of a
#: round in full, what share of all may go into how many sketches, and how far the first steps after them reach.
SKETCH_NEIGHBOURS, SKETCH_COST, SKETCH_SHARE, SKETCH_ROUNDS, SKETCHED_REACH = 4, 0.2, 0.6, 60, 0.003

#: What of it routes with any end may cost, as many as there are without ends: before routes with ends of their own, and where
#: those are too many.
ANY_END_SHARE, ANY_END_ALONE = 0.1, 1.5

#: What a step between two tasks costs at least; more, with the fourth power of how many tasks on a route are remembered. Of the
#: steps to a task, only the shortest are looked at: about so many.
STEP_COST, MEMORY_COST, STEPS_LOOKED_AT = 1.5, 0.04, 150

#: Gaps with which the bound ``tight`` is content in its first round and in its last one; with none at first where there are
#: so few tasks that it costs next to nothing to go on.
GOOD_GAP, FAIR_GAP, FEW_TASKS = 0.01, 0.06, 12

#: Loads and tasks beyond which routes are not even counted for the bound ``tight``.
MOST_BUCKETS = 500_000

#: Memories of ng-routes, by load and two tasks, and by load and task, that a judge goes through at most
#: (docs/certificate.md).
MOST_MEMORIES, MOST_KEPT = 10**11, 25_000_000


def lower_bound(
    scene: Scene, travel: Travel, *, bound: str = "tight", upper: float | None = None, deadline: Deadline = NEVER
) -> Bound:
    """A proven lower bound on the travel of every feasible allocation.

    Args:
        scene: Whose capacities and demands count.
        travel: Distances, metres.
        bound: ``"fast"`` (forest), ``"tight"`` (Held-Karp forest, or ng-routes where they are few) or ``"exact"`` (ng-routes).
        upper: Travel of a known allocation, metres; steers the ascent, proves nothing.
        deadline: When to come back with the best bound proven by then.

    Raises:
        SettingsError: If ``bound`` is unknown or ``upper`` is negative or not a number.
    """
    if bound not in BOUND_EFFORTS:
        raise SettingsError("bound", f"is {bound!r}", f"must be one of {', '.join(BOUND_EFFORTS)}", "choose one")
    if upper is not None and not upper >= 0.0:
        raise SettingsError("upper", f"is {upper!r}", "must be metres >= 0 or None", "give the travel of a known allocation")
    if bound == "fast":
        return forest_bound(scene, travel, rounds=0)
    known = math.inf if upper is None else upper
    return (tight_bound if bound == "tight" else ng_route_bound)(scene, travel, known, deadline=deadline)


def forest_bound(
    scene: Scene, travel: Travel, upper: float = math.inf, *, rounds: int | None = None, deadline: Deadline = NEVER
) -> Bound:
    """The forest under prices on a task's legs (M,) and on a drone's first leg (N,), after so many rounds of ascent."""
    return _forest(scene, travel, upper, rounds, deadline)[0]


def tight_bound(scene: Scene, travel: Travel, upper: float = math.inf, *, deadline: Deadline = NEVER) -> Bound:
    """The forest, or the ng-routes where they prove more and cost little."""
    good = CLOSED_GAP if scene.num_tasks <= FEW_TASKS else GOOD_GAP
    best, prices = _forest(scene, travel, upper, None, deadline)
    if not scene.num_tasks or upper <= best.value:
        return best
    own = _have_ends_of_their_own(scene, travel)
    affordable = _affordable_rounds(scene, travel, 1.0 - ANY_END_SHARE if own else 1.0)
    sketches = min(int(affordable * SKETCH_SHARE / SKETCH_COST), SKETCH_ROUNDS)
    rounds = affordable - int(affordable * SKETCH_SHARE)
    if own:
        before = _affordable_rounds(scene, _without_ends(travel), ANY_END_SHARE if rounds else ANY_END_ALONE)
        best, prices = _any_end(scene, travel, upper, np.linspace(good, FAIR_GAP, before), deadline, best, prices)
    return _priced(scene, travel, upper, np.linspace(good, FAIR_GAP, rounds), deadline, best, prices, sketches)


def ng_route_bound(
    scene: Scene, travel: Travel, upper: float = math.inf, *, rounds: int = NG_ROUNDS, deadline: Deadline = NEVER
) -> Bound:
    """The Lagrangian of all ng-routes within the capacities; its vector is a price for each task (M,).

    Others where they prove more, or there is no time for the first round, or a judge would not go through the routes.
    """
    good = np.full(rounds, CLOSED_GAP)
    best, prices = _forest(scene, travel, upper, None, deadline)
    if not scene.num_tasks or upper <= best.value:
        return best
    if _have_ends_of_their_own(scene, travel):
        best, prices = _any_end(scene, travel, upper, good, deadline, best, prices)
    return _priced(scene, travel, upper, good, deadline, best, prices)


def _any_end(
    scene: Scene, travel: Travel, upper: float, good: FloatArray, deadline: Deadline, best: Bound, prices: FloatArray
) -> tuple[Bound, FloatArray]:
    """Prices (2 M,) of ng-routes whose drones pay for any last leg, which all drones of a class can share; the best bound."""
    open_ended = _without_ends(travel)
    if not len(good) or upper <= best.value * (1.0 + good[0]) or not is_judged(scene, open_ended):
        return best, prices
    groups = group_drones(scene, open_ended)
    least = np.repeat([0.0, -np.inf], scene.num_tasks)
    value, prices = ascend(
        lambda point: evaluate_any_end(groups, travel.task_end, travel.start_end, point, deadline),
        prices, least, rounds=len(good), upper=min(upper, travel_ceiling(travel)), good=good,
    )  # fmt: skip
    return (Bound("ng-route-any-end", value, prices) if value > best.value else best), prices


def _priced(
    scene: Scene, travel: Travel, upper: float, good: FloatArray, deadline: Deadline, best: Bound, prices: FloatArray,
    sketches: int = 0,
) -> Bound:  # fmt: skip
    """The ng-routes where they prove more than ``best``, after as many rounds as ``good`` has, or with one of its gaps.

    Before that, so many rounds are ``sketches``.
    """
    if not len(good) or upper <= best.value * (1.0 + good[0]) or not is_judged(scene, travel):
        return best
    ceiling, reach = min(upper, travel_ceiling(travel)), FIRST_REACH
    matched = match_one_each(scene, travel) if carries_one_at_most(scene) else None
    prices, good = (prices[: scene.num_tasks], good) if matched is None else (matched.prices, good[:1])
    if matched is None and sketches:
        groups, reach = group_drones(scene, travel, SKETCH_NEIGHBOURS), SKETCHED_REACH
        _, prices = ascend_prices(groups, prices, rounds=sketches, upper=ceiling, good=good[0], deadline=deadline)
    value, prices = ascend_prices(
        group_drones(scene, travel), prices, rounds=len(good), upper=ceiling, good=good, reach=reach, deadline=deadline
    )
    return Bound("ng-route", value, prices) if value > best.value else best


def _have_ends_of_their_own(scene: Scene, travel: Travel) -> bool:
    """Whether drones have routes of several tasks that others would share if ends did not count."""
    return not carries_one_at_most(scene) and len(drones_that_share(travel)) > len(drones_that_share(_without_ends(travel)))


def _without_ends(travel: Travel) -> Travel:
    """The same drones, which stay where they serve their last tasks and have to fly."""
    ends = np.zeros_like(travel.task_end)
    return replace(travel, task_end=ends, start_end=np.full(len(ends), np.inf))


def first_prices(scene: Scene, travel: Travel, upper: float = math.inf, deadline: Deadline = NEVER) -> FloatArray:
    """Prices of tasks (M,) that prove about the forest's bound when routes are priced with them."""
    return _forest(scene, travel, upper, None, deadline)[1][: scene.num_tasks]


def _forest(scene: Scene, travel: Travel, upper: float, rounds: int | None, deadline: Deadline) -> tuple[Bound, FloatArray]:
    """The forest's bound, and prices for routes (2 M,): of tasks, and of where routes end and last legs begin."""
    num_tasks, num = scene.num_tasks, scene.num_tasks + scene.num_drones
    legs = max(num_tasks * (num_tasks + 2 * scene.num_drones), 1)
    if rounds is None:
        rounds = min(max(FOREST_ROUNDS, FOREST_LEGS // legs), MOST_FOREST_ROUNDS)
    relaxed = _relaxed(scene, travel)
    ascent, prices, direction, best = begin(), np.zeros(num), np.zeros(num), np.zeros(num)
    try:
        for first, last in deadline.slices(rounds, "proving a bound", first=1 + FOREST_LEGS // legs):
            goes_on = forest.ascend(*relaxed, last - first, min(upper, travel_ceiling(travel)), ascent, prices, direction, best)
            if not goes_on:
                break
    except OutOfTime:
        pass  # what is proven by now counts
    shares = np.empty(num_tasks)
    value = forest.relax(*relaxed, best, np.empty(num), shares)
    shares = np.where(np.isfinite(shares), np.maximum(0.0, shares), 0.0)
    # What the drones that must fly add to the tree is shared out by demand.
    rest = max(value - float(shares.sum() + relaxed[3].sum()), 0.0) if np.isfinite(value) and num_tasks else 0.0
    shares += rest * scene.demands / max(scene.demands.sum(), 1)
    return Bound("two-ended-forest", value, best), np.concatenate([shares, best[:num_tasks]])


def _relaxed(scene: Scene, travel: Travel) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, int]:
    """Legs from starts (N, M), between tasks (M, M), to ends (N, M) and of idle drones (N,), and how many must fly.

    A leg is infinite where its tasks outweigh all that could fly it; between tasks it is the least over classes of drones.
    """
    fits = scene.demands[None, :] <= scene.capacities[:, None]
    starts, ends = (np.where(fits, legs, np.inf) for legs in (travel.start_task, travel.task_end))
    pairs = scene.demands[:, None] + scene.demands[None, :]
    between = np.full(pairs.shape, np.inf)
    for kind, legs in enumerate(travel.task_task):
        most = scene.capacities[travel.drone_class == kind].max(initial=0)
        between = np.where(pairs <= most, np.minimum(between, legs), between)
    idle = np.where(np.isfinite(travel.start_end), travel.start_end, 0.0)
    carried = np.cumsum(np.sort(scene.capacities)[::-1])
    needed = int((carried < scene.demands.sum()).sum()) + 1 if scene.num_tasks else 0
    return starts, between, ends, idle, needed


def _affordable_rounds(scene: Scene, travel: Travel, share: float) -> int:
    """How many times ng-routes may be priced in this share of next to no time."""
    demands, capacities = route_loads(scene)
    if capacities.max() * scene.num_tasks > MOST_BUCKETS:
        return 0
    lightest = np.cumsum(np.sort(demands))
    cost = 0.0
    for drones in drones_that_share(travel):
        most = int(capacities[drones].max())
        remembered = float((lightest <= most).sum()) * min(1.0, NEIGHBOURS / scene.num_tasks)
        steps = count_pairs(demands, most) * min(1.0, STEPS_LOOKED_AT / scene.num_tasks)
        cost += GROUP_COST + (STEP_COST + MEMORY_COST * remembered**4) * steps
    if carries_one_at_most(scene):
        cost /= NG_ROUNDS  # one round is enough
    most_cost = TIGHT_COST + TIGHT_COST_A_TASK * scene.num_tasks * max(1.0, scene.num_tasks / MANY_TASKS)
    rounds = int(share * most_cost / cost)
    return min(rounds, NG_ROUNDS) if rounds >= LEAST_NG_ROUNDS else 0


def is_judged(scene: Scene, travel: Travel) -> bool:
    """Whether a judge goes through the fleet's ng-routes."""
    demands, capacities = route_loads(scene)
    memories, most = 1 << min(NEIGHBOURS - 1, scene.num_tasks - 1), int(capacities.max())
    kept = max(most + 1, (int(demands.max()) + 1) * memories) * scene.num_tasks
    return kept <= MOST_KEPT and len(drones_that_share(travel)) * most * scene.num_tasks**2 * memories <= MOST_MEMORIES
