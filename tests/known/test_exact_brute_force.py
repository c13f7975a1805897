"""Optima and bounds of small fleets of every sort against trying everything."""

import dataclasses
import math

import numpy as np
import pytest

from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.bundles.exact.exact import solve_exact
from flockopt.travel.travel import straight_travel
from tests.instances import random_scene, with_cut_legs
from tests.known.brute_force import least_travel

BATCHES, INSTANCES = 25, 20

#: Relative.
AGREEMENT = 1e-7


def random_fleet(rng):
    """Up to 3 drones and 7 tasks, with ends, demands, longest routes, cut legs and too little capacity now and then."""
    num_drones, num_tasks = int(rng.integers(1, 4)), int(rng.integers(1, 8))
    capacity = [int(c) for c in rng.integers(0, 6, num_drones) + (num_tasks // num_drones)]
    longest = None if rng.uniform() < 0.7 else float(rng.uniform(15, 45))
    scene = random_scene(
        rng, drones=num_drones, tasks=num_tasks, capacity=capacity, ends=rng.uniform() < 0.4, demands=rng.uniform() < 0.4,
        max_distance=longest,
    )  # fmt: skip
    travel = straight_travel(scene)
    if rng.uniform() < 0.2:
        travel = with_cut_legs(rng, travel, 0.3)
    if rng.uniform() < 0.2:  # two classes of drones that need different ways
        classes = rng.integers(0, 2, num_drones)
        travel = dataclasses.replace(
            travel, task_task=np.concatenate([travel.task_task, 1.3 * travel.task_task]), drone_class=classes
        )
    return scene, travel


@pytest.mark.parametrize("batch", range(BATCHES))
def test_every_optimum_is_the_one_found_by_trying_everything(batch):
    rng = np.random.default_rng(batch)
    for case in range(INSTANCES):
        scene, travel = random_fleet(rng)
        expected = least_travel(scene, travel)
        result = solve_exact(scene, travel, seed=case)
        if math.isinf(expected):
            assert result.status == result.bundles.status == "infeasible", (batch, case)
            assert result.proven == math.inf and result.bundles.reason
            continue
        assert result.status == result.bundles.status == "optimal", (batch, case)
        assert travel.total(result.bundles.routes) == pytest.approx(expected, rel=AGREEMENT, abs=1e-9), (batch, case)
        assert result.proven == pytest.approx(expected, rel=AGREEMENT, abs=1e-9)
        assert sorted(task for route in result.bundles for task in route) == list(range(scene.num_tasks))
        bounds = [result.bound.value, *(lower_bound(scene, travel, bound=kind).value for kind in ("fast", "tight"))]
        assert max(bounds) <= expected * (1 + 1e-12) + 1e-9, (batch, case, bounds)


def test_the_instances_are_of_every_sort():
    optima = [least_travel(*random_fleet(np.random.default_rng(batch))) for batch in range(100)]
    assert 10 < sum(map(math.isinf, optima)) < 50
