"""What holds for the bundles of any scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flockopt import refine_bundles
from flockopt.travel.travel import straight_travel
from tests.instances import random_scene

SCENES = st.builds(
    lambda seed, **about: random_scene(np.random.default_rng(seed), **about),
    st.integers(0, 10**6),
    drones=st.integers(1, 6),
    tasks=st.integers(0, 25),
    capacity=st.integers(0, 9),
    ends=st.booleans(),
    demands=st.booleans(),
    max_distance=st.sampled_from([None, 10.0, 40.0]),
)


@settings(max_examples=60, deadline=None)
@given(scene=SCENES, seed=st.integers(0, 99), iterations=st.integers(0, 200))
def test_no_limit_is_ever_broken_and_no_task_forgotten(scene, seed, iterations):
    travel = straight_travel(scene)
    bundles = refine_bundles(scene, travel=travel, seed=seed, iterations=iterations)
    served = [task for route in bundles for task in route]
    assert sorted(served + [task for task, _ in bundles.unserved]) == list(range(scene.num_tasks))
    assert (bundles.status in ("infeasible", "incomplete")) == bool(bundles.unserved or bundles.reason)
    for drone, route in enumerate(bundles):
        limit = scene.drones[drone].max_distance
        assert scene.demands[list(route)].sum() <= scene.capacities[drone]
        assert not route or travel.route_length(drone, route) <= (math.inf if limit is None else limit + 1e-9)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_optimum_does_not_depend_on_the_order_of_drones_and_tasks(seed):
    pytest.importorskip("highspy", reason="highspy comes with the extra 'solvers'")
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, drones=4, tasks=10, capacity=4, ends=True)
    drones, tasks = rng.permutation(4), rng.permutation(10)
    other = scene.replace(drones=tuple(scene.drones[i] for i in drones), tasks=tuple(scene.tasks[j] for j in tasks))
    found = [refine_bundles(each, travel=straight_travel(each), method="exact") for each in (scene, other)]
    costs = [straight_travel(each).total(bundles.routes) for each, bundles in zip((scene, other), found, strict=True)]
    assert found[0].status == found[1].status == "optimal"
    assert abs(costs[0] - costs[1]) <= 1e-6 * costs[0]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), scale=st.floats(0.01, 100.0))
def test_preferences_count_by_their_ratios(seed, scale):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, drones=4, tasks=10, capacity=4)
    preferences, travel = rng.random((4, 10)), straight_travel(scene)
    plain, scaled = (refine_bundles(scene, probs, travel=travel, iterations=0) for probs in (preferences, preferences * scale))
    assert plain.routes == scaled.routes
