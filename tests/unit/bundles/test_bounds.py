"""Bounds: hand-made cases with known values, and how bad input is met."""

import dataclasses
import math

import numpy as np
import pytest

from flockopt.batches.deadline import Deadline, OutOfTime
from flockopt.bundles.bounds.bounds import forest_bound, lower_bound
from flockopt.bundles.exact.exact import solve_exact
from flockopt.certificate.proof import recompute_bound
from flockopt.errors import SettingsError
from flockopt.scene import Bounds, Drone, Scene, Task
from flockopt.travel.travel import straight_travel
from tests.instances import random_instance
from tests.known.brute_force import least_travel


def line_scene(starts, tasks, capacities, demands=None, ends=None):
    """Drones and tasks on the x axis."""
    demands = demands or [1] * len(tasks)
    stops = [None if end is None else (end, 0, 0) for end in ends or [None] * len(starts)]
    drones = tuple(Drone(f"d{i}", (x, 0, 0), capacities[i], 0.1, 1, 1, 1, end=stops[i]) for i, x in enumerate(starts))
    places = tuple(Task(f"t{j}", (x, 0, 0), demands[j]) for j, x in enumerate(tasks))
    return Scene("line", Bounds((-50, -50, -50), (50, 50, 50)), drones, places)


@pytest.mark.parametrize("kind", ["fast", "tight"])
def test_one_drone_on_a_line_is_bounded_exactly(kind):
    scene = line_scene([0.0], [1.0, 2.0, 5.0], [3])
    assert lower_bound(scene, straight_travel(scene), bound=kind).value == pytest.approx(5.0)


def test_the_prices_see_what_the_tree_does_not():
    # A star: the tree pays 1 + 1 + 1, but a route through the middle pays 1 + 2 for its two last tasks.
    tasks = tuple(Task(f"t{j}", p) for j, p in enumerate([(1, 0, 0), (2, 0, 0), (1, 1, 0), (1, -1, 0)]))
    scene = Scene("star", Bounds((-9, -9, -9), (9, 9, 9)), (Drone("d", (0, 0, 0), 4, 0.1, 1, 1, 1),), tasks)
    travel = straight_travel(scene)
    fast, tight = (lower_bound(scene, travel, bound=kind).value for kind in ("fast", "tight"))
    assert fast == pytest.approx(4.0)
    assert 4.3 < tight <= travel.route_length(0, (0, 2, 1, 3)) + 1e-9


def test_each_start_counts_once():
    # Both tasks are 1 m from drone 0, 2 m from one another and far from drone 1.
    scene = line_scene([0.0, 9.0], [-1.0, 1.0], [2, 2])
    travel = straight_travel(scene)
    assert lower_bound(scene, travel, bound="fast").value == pytest.approx(2.0)
    assert lower_bound(scene, travel, bound="tight").value == pytest.approx(3.0, rel=1e-3)


def test_a_start_that_cannot_carry_a_task_is_no_root():
    scene = line_scene([0.0, 10.0], [1.0], [1, 2], demands=[2])
    assert lower_bound(scene, straight_travel(scene), bound="fast").value == pytest.approx(9.0)


@pytest.mark.parametrize("kind", ["fast", "tight"])
def test_nothing_to_do_costs_nothing(kind):
    scene = line_scene([0.0, 3.0], [], [1, 1])
    bound = lower_bound(scene, straight_travel(scene), bound=kind)
    assert bound.value == 0.0


@pytest.mark.parametrize("kind", ["fast", "tight"])
def test_a_task_that_no_drone_can_carry_alone_has_infinite_cost(kind):
    scene = line_scene([0.0], [1.0], [3], demands=[4])
    assert math.isinf(lower_bound(scene, straight_travel(scene), bound=kind).value)


def test_unreachable_pairs_only_matter_when_needed():
    scene = line_scene([0.0, 1.0], [2.0, 3.0], [2, 2])
    travel = straight_travel(scene)
    travel.start_task[0] = np.inf
    assert lower_bound(scene, travel, bound="tight").value == pytest.approx(2.0)
    travel.start_task[:, 1] = np.inf
    travel.task_task[0, 0, 1] = travel.task_task[0, 1, 0] = np.inf
    assert lower_bound(scene, travel, bound="tight").value == math.inf


def test_the_dual_has_a_price_for_each_task_and_start():
    scene = line_scene([0.0, 4.0], [1.0, 2.0, 5.0], [3, 2])
    bound = lower_bound(scene, straight_travel(scene), bound="tight", upper=6.0)
    assert bound.kind == "two-ended-forest"
    assert bound.dual.shape == (5,)


@pytest.mark.parametrize("kind", ["fast", "tight", "exact"])
def test_drones_without_tasks_fly_to_their_ends(kind):
    scene = line_scene([0.0, 3.0], [], [1, 1], ends=[10.0, None])
    assert lower_bound(scene, straight_travel(scene), bound=kind).value == pytest.approx(10.0)
    scene = line_scene([0.0, 30.0], [1.0], [1, 1], ends=[10.0, 30.5])
    assert lower_bound(scene, straight_travel(scene), bound=kind).value == pytest.approx(10.5)


@pytest.mark.parametrize("kind", ["tight", "exact"])
@pytest.mark.parametrize("tasks", [1, 2, 6, 8])
def test_one_drone_with_an_end_is_bounded_exactly(kind, tasks):
    scene, travel = random_instance(np.random.default_rng(tasks), drones=1, tasks=tasks, capacity=tasks, ends=True)
    best = least_travel(scene, travel) if tasks < 8 else solve_exact(scene, travel).proven
    assert lower_bound(scene, travel, bound=kind, upper=best).value == pytest.approx(best, rel=1e-3)


def test_as_many_drones_fly_as_it_takes_to_carry_everything():
    # Two tasks on one side, three drones on the other that carry one and a half of them: two drones have to come.
    scene = line_scene([0.0, 0.5, 1.0], [20.0, 21.0], [3, 3, 3], demands=[2, 2])
    travel = straight_travel(scene)
    assert lower_bound(scene, travel, bound="fast").value == pytest.approx(19.0 + 20.0)  # nothing leads from task to task
    assert lower_bound(scene, travel, bound="tight", upper=39.5).value == pytest.approx(39.5)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("demand", [1, 3])
def test_where_drones_carry_one_task_the_assignment_leaves_no_gap(seed, demand):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=9, tasks=6, capacity=demand, ends=seed % 3 > 0)
    scene = scene.replace(tasks=tuple(dataclasses.replace(task, demand=demand) for task in scene.tasks))
    assert lower_bound(scene, travel).value == pytest.approx(least_travel(scene, travel), rel=1e-12)


@pytest.mark.parametrize("kind", ["fast", "tight", "exact"])
def test_a_deadline_that_has_passed_leaves_a_bound_that_holds(kind):
    scene, travel = random_instance(np.random.default_rng(3), drones=3, tasks=6, capacity=3, ends=True)
    bound = lower_bound(scene, travel, bound=kind, deadline=Deadline(0.0))
    assert 0.0 < bound.value == pytest.approx(recompute_bound(scene, travel, bound))
    assert bound.value <= least_travel(scene, travel)


def test_a_deadline_keeps_what_is_proven_by_then(monkeypatch):
    scene, travel = random_instance(np.random.default_rng(3), drones=4, tasks=30, capacity=9)

    def first_round_only(deadline, rounds, doing, first=1):
        yield 0, 1
        raise OutOfTime(doing)

    never = lower_bound(scene, travel, bound="tight").value
    monkeypatch.setattr(Deadline, "slices", first_round_only)
    stopped = lower_bound(scene, travel, bound="tight").value
    assert lower_bound(scene, travel, bound="fast").value <= stopped < never


@pytest.mark.parametrize("kind", ["tight", "exact"])
def test_where_slices_end_changes_nothing(kind, monkeypatch):
    scene, travel = random_instance(np.random.default_rng(4), drones=4, tasks=14, capacity=5, ends=True, demands=True)
    whole = lower_bound(scene, travel, bound=kind)
    monkeypatch.setattr(Deadline, "slices", lambda deadline, rounds, doing, first=1: iter([(k, k + 1) for k in range(rounds)]))
    sliced = lower_bound(scene, travel, bound=kind)
    assert (whole.kind, whole.value) == (sliced.kind, sliced.value)
    assert (whole.dual == sliced.dual).all()


def test_a_proven_optimum_without_tasks_is_what_drones_fly_to_their_ends():
    scene = line_scene([0.0, 3.0], [], [1, 1], ends=[10.0, None])
    travel = straight_travel(scene)
    result = solve_exact(scene, travel)
    assert (result.status, result.proven) == ("optimal", 10.0)
    assert result.bound.value == recompute_bound(scene, travel, result.bound) == 10.0


def test_what_no_judge_would_go_through_is_not_claimed():
    scene = line_scene([0.0], [1.0, 3.0], [10**9], demands=[10**8, 10**8 + 1])
    travel = straight_travel(scene)
    for kind in ("tight", "exact"):
        assert lower_bound(scene, travel, bound=kind).kind == "two-ended-forest"
    assert solve_exact(scene, travel).proven == pytest.approx(3.0)


def test_many_tasks_are_priced_by_routes_too():
    scene, travel = random_instance(np.random.default_rng(2), drones=40, tasks=300, capacity=9)
    forest, bound = forest_bound(scene, travel), lower_bound(scene, travel, bound="tight")
    assert bound.kind == "ng-route"
    assert bound.value > 1.02 * forest.value
    assert recompute_bound(scene, travel, bound) == pytest.approx(bound.value, rel=1e-12)


@pytest.mark.parametrize(("setting", "value"), [("bound", "tightest"), ("upper", math.nan), ("upper", -1.0)])
def test_bad_settings_are_named(setting, value):
    scene = line_scene([0.0], [1.0], [1])
    with pytest.raises(SettingsError) as caught:
        lower_bound(scene, straight_travel(scene), **{setting: value})
    assert caught.value.field == setting
