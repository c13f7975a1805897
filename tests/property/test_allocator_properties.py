"""Whatever the fleet: no capacity, longest route or task is overdrawn, and relabelling drones or tasks relabels bundles."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flockopt.travel.travel import straight_travel
from tests.instances import random_instance, random_scene, with_cut_legs

pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.teacher.allocators import ALLOCATORS, load_allocator
from learned.teacher.refinement import refine

METHODS = {method: load_allocator(method) for method in ALLOCATORS}

#: Lengths are float32 inside the allocators.
TOLERANCE_M = 1e-3


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), method=st.sampled_from(sorted(METHODS)), refines=st.booleans())
def test_nothing_is_overdrawn(seed, method, refines):
    rng = np.random.default_rng(seed)
    drones, tasks = int(rng.integers(1, 8)), int(rng.integers(0, 16))
    capacity = [int(c) for c in rng.integers(0, 7, drones)]
    longest = float(rng.uniform(10, 80)) if rng.uniform() < 0.5 else None
    scene = random_scene(rng, drones=drones, tasks=tasks, capacity=capacity, ends=True, demands=True, max_distance=longest)
    travel = with_cut_legs(rng, straight_travel(scene), 0.1)
    (allocation,) = METHODS[method].bundles([scene], [travel])
    routes = refine([scene], [travel], [allocation.routes])[0] if refines else allocation.routes
    bundled = [task for route in routes for task in route]
    assert len(set(bundled)) == len(bundled)
    assert set(bundled) <= set(range(tasks))
    for drone, route in enumerate(routes):
        assert sum(scene.tasks[task].demand for task in route) <= capacity[drone]
        assert np.isfinite(travel.route_length(drone, route))
        assert longest is None or not route or travel.route_length(drone, route) <= longest + TOLERANCE_M


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), method=st.sampled_from(sorted(METHODS)))
def test_relabelling_relabels_bundles(seed, method):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=6, tasks=11, capacity=3)
    drones, tasks = rng.permutation(6), rng.permutation(11)
    other = scene.replace(drones=tuple(scene.drones[i] for i in drones), tasks=tuple(scene.tasks[j] for j in tasks))
    same = dataclasses.replace(
        travel, start_task=travel.start_task[drones][:, tasks], task_task=travel.task_task[:, tasks][:, :, tasks]
    )
    (ours,), (theirs,) = METHODS[method].bundles([scene], [travel]), METHODS[method].bundles([other], [same])
    named = [tuple(int(tasks[task]) for task in route) for route in theirs.routes]
    assert named == [ours.routes[drone] for drone in drones]
