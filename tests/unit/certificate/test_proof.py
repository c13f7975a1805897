"""Bounds recomputed from their proofs: what the definition says, and valid whatever the vector holds."""

import dataclasses
import itertools

import numpy as np
import pytest

from flockopt.bundles import Bound
from flockopt.certificate import optimum
from flockopt.certificate.proof import KINDS, recompute_bound
from flockopt.errors import PlanError
from flockopt.scene import Bounds, Drone, Scene, Task
from flockopt.travel.travel import straight_travel
from tests.instances import random_instance, with_cut_legs


def cheapest_travel(scene, travel):
    """By brute force: every assignment of tasks to drones, every order."""
    num = scene.num_tasks
    best = np.full((scene.num_drones, 1 << num), np.inf)
    for drone, members in itertools.product(range(scene.num_drones), range(1 << num)):
        tasks = [task for task in range(num) if members >> task & 1]
        if scene.demands[tasks].sum() <= scene.capacities[drone]:
            best[drone, members] = min(travel.route_length(drone, order) for order in itertools.permutations(tasks))
    total = best[0]
    for drone in range(1, scene.num_drones):
        merged = np.full(1 << num, np.inf)
        for members in range(1 << num):
            part = members
            while True:
                merged[members] = min(merged[members], total[members ^ part] + best[drone, part])
                if part == 0:
                    break
                part = (part - 1) & members
        total = merged
    return total[-1]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(8))
def test_any_vector_proves_a_bound_below_the_cheapest_travel(kind, seed):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=3, tasks=5, capacity=[3, 2, 4], ends=seed % 2 == 1, demands=seed % 3 == 0)
    if seed >= 6:
        travel = with_cut_legs(rng, travel, 0.2)
    cheapest = cheapest_travel(scene, travel)
    for scale in (0.1, 1.0, 10.0):
        dual = rng.normal(size=KINDS[kind].length(scene)) * scale
        value = recompute_bound(scene, travel, Bound(kind, 1e9, dual))
        assert value <= cheapest + 1e-9
        if not KINDS[kind].is_signed:
            assert value == recompute_bound(scene, travel, Bound(kind, 1e9, np.maximum(dual, 0.0)))


@pytest.mark.parametrize("seed", range(5))
def test_any_end_is_paid_for_where_routes_end(seed):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=2, tasks=5, capacity=[4, 5], ends=True, demands=True)
    prices, turns = rng.uniform(0, 15, 5), rng.normal(0, 4, 5)
    expected = prices.sum()
    routes = [route for size in range(1, 6) for route in itertools.permutations(range(5), size)]
    for drone in range(2):
        last = (travel.task_end[drone] + turns).min()
        flown = [
            travel.route_length(drone, route) - travel.task_end[drone, route[-1]] - prices[list(route)].sum() - turns[route[-1]]
            for route in routes
            if scene.demands[list(route)].sum() <= scene.capacities[drone]
        ]
        expected += min(travel.start_end[drone], min(flown) + last)
    dual = np.concatenate([prices, turns])
    assert recompute_bound(scene, travel, Bound("ng-route-any-end", 0.0, dual)) == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(5))
def test_ng_routes_over_whole_neighbourhoods_price_elementary_routes_exactly(seed):
    """With at most eight tasks a neighbourhood holds them all, so that the value is that of elementary routes."""
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=2, tasks=6, capacity=[4, 5], ends=seed % 2 == 0, demands=True)
    prices = rng.uniform(0, 15, 6)
    expected = prices.sum()
    for drone in range(2):
        routes = (route for size in range(7) for route in itertools.permutations(range(6), size))
        expected += min(
            travel.route_length(drone, route) - prices[list(route)].sum()
            for route in routes
            if scene.demands[list(route)].sum() <= scene.capacities[drone]
        )
    assert recompute_bound(scene, travel, Bound("ng-route", 0.0, prices)) == pytest.approx(expected)


def test_rooted_forest_by_hand():
    scene, travel = random_instance(np.random.default_rng(0), drones=2, tasks=3, capacity=[1, 0])
    start_task = np.array([[2.0, 9.0, 9.0], [0.0, 0.0, 0.0]])  # the second drone can carry nothing
    task_task = np.array([[[0.0, 1.0, 5.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0]]])
    travel = dataclasses.replace(travel, start_task=start_task, task_task=task_task)
    assert recompute_bound(scene, travel, Bound("rooted-forest", 0.0, np.empty(0))) == 3.0
    dual = np.array([0.0, 1.0, 0.0, 0.5, 0.0])  # legs 2.5, 2 and 1, less twice the 1, less the 0.5
    assert recompute_bound(scene, travel, Bound("held-karp-forest", 0.0, dual)) == 3.0


@pytest.mark.parametrize("kind", KINDS)
def test_cut_off_tasks_and_no_tasks(kind):
    scene, travel = random_instance(np.random.default_rng(1), drones=2, tasks=3, capacity=3)
    cut = dataclasses.replace(travel, start_task=np.full((2, 3), np.inf), task_task=np.full((1, 3, 3), np.inf))
    value = recompute_bound(scene, cut, Bound(kind, 0.0, np.zeros(KINDS[kind].length(scene))))
    assert value == (np.inf if "forest" in kind else 0.0)
    empty, away = random_instance(np.random.default_rng(1), drones=2, tasks=0, capacity=1, ends=True)
    idle = away.start_end.sum() if KINDS[kind].is_signed else 0.0
    assert away.start_end.sum() > 1.0
    assert recompute_bound(empty, away, Bound(kind, 0.0, np.zeros(KINDS[kind].length(empty)))) == pytest.approx(idle)


@pytest.mark.parametrize(
    "kind, dual, field",
    [
        ("simplex", np.zeros(5), "kind"),
        ("rooted-forest", np.zeros(1), "dual"),
        ("held-karp-forest", np.zeros(4), "dual"),
        ("held-karp-forest", np.zeros((5, 1)), "dual"),
        ("two-ended-forest", np.zeros(3), "dual"),
        ("two-ended-forest", np.array([1.0, 0.0, 0.0, -2e8, 0.0]), "dual"),
        ("ng-route", np.array([1.0, 1e16, 1.0]), "dual"),
        ("ng-route", np.array([1.0, np.nan, 1.0]), "dual"),
        ("ng-route", np.array([1.0, np.inf, 1.0]), "dual"),
    ],
)
def test_proofs_that_are_none_are_named(kind, dual, field):
    scene, travel = random_instance(np.random.default_rng(2), drones=2, tasks=3, capacity=3)
    with pytest.raises(PlanError) as caught:
        recompute_bound(scene, travel, Bound(kind, 0.0, dual))
    assert caught.value.field == field


def line_of(starts, tasks, capacities, demands, ends):
    """Drones and tasks on the x axis."""
    bounds = Bounds((-50.0, -1.0, 0.0), (50.0, 1.0, 1.0))
    drones = tuple(
        Drone(f"d{i}", (x, 0.0, 0.5), capacities[i], 1e-3, 1.0, 1.0, 1.0, end=ends[i] and (ends[i], 0.0, 0.5))
        for i, x in enumerate(starts)
    )
    places = tuple(Task(f"t{j}", (x, 0.0, 0.5), demands[j]) for j, x in enumerate(tasks))
    scene = Scene("line", bounds, drones, places)
    return scene, straight_travel(scene)


def test_two_ended_forest_by_hand():
    # The first drone goes on to 10 m, the second rests where it is done: idle 10 m and 0 m.
    scene, travel = line_of([0.0, 20.0], [1.0, 3.0, 6.0], [3, 3], [1, 1, 1], [10.0, None])

    def value(prices=(0.0, 0.0, 0.0), first=(0.0, 0.0), capacities=(3, 3)):
        drones = tuple(dataclasses.replace(drone, capacity=c) for drone, c in zip(scene.drones, capacities, strict=True))
        dual = np.array([*prices, *first])
        return recompute_bound(scene.replace(drones=drones), travel, Bound("two-ended-forest", 0.0, dual))

    # The tree is 6 m; 10 m of idling less the change to an end that is 4 m away; no change for the second drone.
    assert value() == pytest.approx(6.0 + 10.0 - 6.0)
    # The first drone earns its 4 m back at its last leg, and the second drone's change of 0 m does not count, nor 9 m.
    assert value(first=(4.0, 0.0)) == pytest.approx(10.0 + 10.0 - 10.0)
    assert value(first=(0.0, -9.0)) == pytest.approx(1.0 + 2.0 + 3.0 + 4.0)
    # Legs of the last task cost 2 m each: at the tree's only one, at the end, and taken off twice.
    assert value(prices=(0.0, 0.0, 2.0)) == pytest.approx(8.0 + 10.0 - 4.0 - 4.0 + min(0.0, 4.0 - 3.0 - 1.0))
    # Neither can carry all: the second drone has to fly, at no less than nothing more, and is too weak for two tasks.
    assert value(first=(0.0, -2.0), capacities=(2, 1)) == pytest.approx(6.0 + 4.0 + 2.0)
    # Nobody carries two tasks, so that all legs are first ones; and two drones are not enough for three tasks.
    assert value(capacities=(1, 1)) == np.inf
    lighter, shorter = line_of([0.0, 20.0], [1.0, 6.0], [1, 1], [1, 1], [10.0, None])
    assert recompute_bound(lighter, shorter, Bound("two-ended-forest", 0.0, np.zeros(4))) == pytest.approx(7.0 + 4.0)


def test_demands_count_in_their_largest_unit():
    """Grams or kilograms: the same routes, and as much to remember."""
    scene, travel = line_of([0.0, 9.0], [1.0, 3.0, 6.0], [4, 3], [2, 1, 2], [None, 8.0])
    grams = scene.replace(
        drones=tuple(dataclasses.replace(drone, capacity=1000 * drone.capacity + 7) for drone in scene.drones),
        tasks=tuple(dataclasses.replace(task, demand=1000 * task.demand) for task in scene.tasks),
    )
    for kind in ("ng-route", "optimum"):
        proof = Bound(kind, 12.0, np.array([2.0, 1.0, 3.0]))
        assert recompute_bound(grams, travel, proof) == recompute_bound(scene, travel, proof) > 0.0


@pytest.mark.parametrize("kind", ["ng-route", "optimum"])
def test_more_loads_than_a_judge_goes_through_are_refused(kind):
    scene, travel = line_of([0.0], [1.0, 3.0], [10**9], [10**8, 10**8 + 1], [None])
    with pytest.raises(PlanError, match="kind has too many routes to recheck"):
        recompute_bound(scene, travel, Bound(kind, 1.0, np.zeros(2)))


def test_drones_of_several_classes_use_their_own_matrices():
    scene, travel = random_instance(np.random.default_rng(3), drones=2, tasks=4, capacity=4)
    wide = travel.task_task[0] * 1.5
    two = dataclasses.replace(travel, task_task=np.stack([travel.task_task[0], wide]), drone_class=np.array([0, 1]))
    prices = np.full(4, 8.0)
    mixed = recompute_bound(scene, two, Bound("ng-route", 0.0, prices))
    assert mixed >= recompute_bound(scene, travel, Bound("ng-route", 0.0, prices))
    assert mixed <= cheapest_travel(scene, two)


@pytest.mark.parametrize("seed", range(12))
def test_the_optimum_is_found_again_and_nothing_above_it(seed):
    """Whatever the prices: the claim of the brute-force optimum holds, a higher one comes down to it, a lower one stays."""
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=3, tasks=5, capacity=[3, 2, 4], ends=seed % 2 == 1, demands=seed % 3 == 0)
    best = cheapest_travel(scene, travel)
    for prices in (np.zeros(5), rng.uniform(0, 8, 5)):
        assert recompute_bound(scene, travel, Bound("optimum", best, prices)) == best
        assert recompute_bound(scene, travel, Bound("optimum", 1.1 * best, prices)) == pytest.approx(best)
        assert recompute_bound(scene, travel, Bound("optimum", 0.9 * best, prices)) == pytest.approx(0.9 * best)


def test_the_optimum_heeds_how_far_drones_may_fly():
    """The near drone may not fly the long round, so the best is dearer than without the limit."""
    rng = np.random.default_rng(5)
    scene, travel = random_instance(rng, drones=2, tasks=4, capacity=4)
    free = cheapest_travel(scene, travel)
    lengths = [travel.route_length(drone, order) for drone in range(2) for order in itertools.permutations(range(4))]
    reach = min(lengths) * 0.6
    drones = tuple(dataclasses.replace(drone, max_distance=reach) for drone in scene.drones)
    bound = recompute_bound(scene.replace(drones=drones), travel, Bound("optimum", 2.0 * free, np.zeros(4)))
    assert bound > free + 1e-6


@pytest.mark.parametrize("value, field", [(np.nan, "value"), (1e9, "dual")])
def test_claims_that_cannot_be_rechecked_are_named(value, field, monkeypatch):
    monkeypatch.setattr(optimum, "MOST_ROUTES", 20)
    scene, travel = random_instance(np.random.default_rng(2), drones=2, tasks=5, capacity=5)
    with pytest.raises(PlanError) as caught:
        recompute_bound(scene, travel, Bound("optimum", value, np.zeros(5)))
    assert caught.value.field == field


def test_drones_that_cannot_idle_are_flown():
    """The second drone has no way from its start to its end without tasks: it must serve some."""
    scene, travel = random_instance(np.random.default_rng(4), drones=2, tasks=3, capacity=3, ends=True)
    travel = dataclasses.replace(travel, start_end=np.array([travel.start_end[0], np.inf]))
    best = cheapest_travel(scene, travel)
    assert recompute_bound(scene, travel, Bound("optimum", best, np.zeros(3))) == best
    assert recompute_bound(scene, travel, Bound("optimum", best + 5.0, np.zeros(3))) == pytest.approx(best)


def test_rechecking_ends_where_its_budget_does(monkeypatch):
    """Routes that take too many steps to list are refused; a choice out of branches proves what it had proven by then."""
    scene, travel = random_instance(np.random.default_rng(2), drones=2, tasks=5, capacity=5)
    claim = Bound("optimum", 1e9, np.zeros(5))
    best = recompute_bound(scene, travel, claim)
    with monkeypatch.context() as patch:
        patch.setattr(optimum, "MOST_BRANCHES", 1)
        assert recompute_bound(scene, travel, claim) <= best + 1e-9
    monkeypatch.setattr(optimum, "MOST_STEPS", 50)
    with pytest.raises(PlanError, match="dual proves too little to recheck"):
        recompute_bound(scene, travel, claim)
