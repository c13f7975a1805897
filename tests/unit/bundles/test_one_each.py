"""A task a drone at most: the assignment against trying everything, and the prices that prove it."""

import numpy as np
import pytest

from flockopt.bundles.bounds.one_each import carries_one_at_most, match_one_each
from flockopt.bundles.refine import refine_bundles
from tests.instances import random_instance, random_scene, with_cut_legs
from tests.known.brute_force import least_travel


@pytest.mark.parametrize(
    ("capacity", "demands", "expected"),
    [([1, 1], [1, 1], True), ([1, 2], [1, 1], False), ([4, 4], [2, 3, 9], True), ([5, 4], [3, 2], False), ([9, 9], [1], True)],
)
def test_the_two_lightest_tasks_decide(capacity, demands, expected):
    scene = random_scene(np.random.default_rng(0), drones=2, tasks=len(demands), capacity=capacity)
    weighed = tuple(type(task)(task.id, task.position, demand) for task, demand in zip(scene.tasks, demands, strict=True))
    assert carries_one_at_most(scene.replace(tasks=weighed)) == expected


@pytest.mark.parametrize("seed", range(12))
def test_the_matching_is_the_best_and_its_prices_prove_it(seed):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=int(rng.integers(5, 8)), tasks=5, capacity=1, ends=seed % 2 == 0)
    travel = with_cut_legs(rng, travel, 0.2) if seed % 3 == 0 else travel
    matched, best = match_one_each(scene, travel), least_travel(scene, travel)
    if matched is None:
        assert best == np.inf
        return
    assert travel.total(matched.routes) == pytest.approx(best)
    alone = travel.start_task + travel.task_end - matched.prices
    proven = matched.prices.sum() + np.minimum(travel.start_end, alone.min(axis=1)).sum()
    assert proven == pytest.approx(best, rel=1e-12)
    assert (matched.prices >= 0.0).all()


def test_too_few_drones_are_no_match():
    scene, travel = random_instance(np.random.default_rng(1), drones=2, tasks=3, capacity=1)
    assert match_one_each(scene, travel) is None


@pytest.mark.parametrize("seed", range(8))
def test_bundles_of_one_task_each_are_optimal_within_every_range(seed):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=7, tasks=5, capacity=1, ends=seed % 2 == 0, max_distance=14.0)
    best = least_travel(scene, travel)
    bundles = refine_bundles(scene, travel=travel)
    if best < np.inf:
        assert travel.total(bundles.routes) == pytest.approx(best)
    else:
        assert bundles.status != "feasible"
