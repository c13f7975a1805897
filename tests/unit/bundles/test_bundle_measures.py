"""The paper's measures of bundles, on cases small enough to do by hand."""

from __future__ import annotations

import pytest

from flockopt import compute_travel
from flockopt.bundles.bundles import bundle_compactness, insertion_cost, tasks_per_drone_std
from tests.flights import drone, make_scene


def test_compactness_is_the_spread_of_bundles_over_the_spread_of_all():
    places = [(0, 0, 0), (2, 0, 0), (10, 0, 0), (12, 0, 0)]
    assert bundle_compactness([(0, 1), (2, 3)], places) == pytest.approx(1.0 / 5.0)
    assert bundle_compactness([(0, 1, 2, 3), ()], places) == pytest.approx(1.0)
    assert bundle_compactness([(0,), (1,)], places) is None
    assert bundle_compactness([(0, 1)], [(1, 1, 1), (1, 1, 1)]) is None


def test_insertion_cost_is_what_leaving_a_task_out_saves():
    scene = make_scene([drone(0, (1, 1, 1))], [(3, 1, 1), (6, 1, 1)])
    travel = compute_travel(scene)
    assert insertion_cost(travel, [(0, 1)]) == pytest.approx((0.0 + 3.0) / 2)
    assert insertion_cost(travel, [(1, 0)]) == pytest.approx((8.0 - 2.0 + 8.0 - 5.0) / 2)
    assert insertion_cost(travel, [()]) is None


def test_tasks_per_drone_counts_idle_drones():
    assert tasks_per_drone_std([(0, 1), ()]) == 1.0
