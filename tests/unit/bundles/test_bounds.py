"""Bounds: hand-made cases with known values, and how bad input is met."""

import math

import numpy as np
import pytest

from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.errors import SettingsError
from flockopt.scene import Bounds, Drone, Scene, Task
from flockopt.travel.travel import straight_travel


def line_scene(starts, tasks, capacities, demands=None):
    """Drones and tasks on the x axis."""
    demands = demands or [1] * len(tasks)
    drones = tuple(Drone(f"d{i}", (x, 0, 0), capacities[i], 0.1, 1, 1, 1) for i, x in enumerate(starts))
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
    assert bound.kind == "held-karp-forest"
    assert bound.dual.shape == (5,) and (bound.dual >= 0).all()


@pytest.mark.parametrize(("setting", "value"), [("bound", "tightest"), ("upper", math.nan), ("upper", -1.0)])
def test_bad_settings_are_named(setting, value):
    scene = line_scene([0.0], [1.0], [1])
    with pytest.raises(SettingsError) as caught:
        lower_bound(scene, straight_travel(scene), **{setting: value})
    assert caught.value.field == setting
