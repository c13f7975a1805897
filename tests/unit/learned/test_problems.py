"""Allocation problems as tensors: what scenes become, and what is drawn at random."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from flockopt import SettingsError
from flockopt.travel.travel import straight_travel
from tests.instances import random_instance, random_scene
from tests.plain_allocation import plain_scale

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.teacher.problems import Problems, random_capacities, random_problems  # noqa: E402 - torch may be missing


def instances(*sizes):
    rng = np.random.default_rng(3)
    return zip(*[random_instance(rng, drones=n, tasks=m, capacity=3) for n, m in sizes], strict=True)


def test_scenes_of_different_sizes_share_a_batch():
    scenes, travels = instances((2, 5), (4, 3))
    problems = Problems.of(scenes, travels)
    assert problems.start_task.shape == (2, 4, 5)
    assert problems.task_mask.tolist() == [[True] * 5, [True] * 3 + [False] * 2]
    assert problems.drone_mask.tolist() == [[True] * 2 + [False] * 2, [True] * 4]
    assert problems.capacity.tolist() == [[3, 3, 0, 0], [3, 3, 3, 3]]
    for row, (scene, travel) in enumerate(zip(scenes, travels, strict=True)):
        n, m = scene.num_drones, scene.num_tasks
        assert np.allclose(problems.start_task[row, :n, :m], travel.start_task, rtol=1e-6)
        assert np.allclose(problems.task_task[row, 0, :m, :m], travel.task_task[0], rtol=1e-6)
        assert float(problems.scale[row]) == pytest.approx(plain_scale(scene, travel), rel=1e-5)


def test_each_class_of_drones_keeps_its_matrix():
    (scene,), (travel,) = instances((3, 4))
    matrices = np.concatenate([travel.task_task, 2 * travel.task_task])
    travel = dataclasses.replace(travel, task_task=matrices, drone_class=np.array([1, 0, 1]))
    problems = Problems.of([scene], [travel])
    assert np.allclose(problems.task_task[0], matrices)
    assert problems.drone_class[0].tolist() == [1, 0, 1]


def test_limits_and_ends_are_kept():
    scene = random_scene(np.random.default_rng(0), drones=4, tasks=2, capacity=1, ends=True, max_distance=30.0)
    travel = straight_travel(scene)
    problems = Problems.of([scene], [travel])
    assert problems.max_distance.tolist() == [[30.0] * 4]
    assert np.allclose(problems.task_end[0], travel.task_end)
    assert np.allclose(problems.start_end[0], travel.start_end)


def test_a_scene_without_any_way_has_a_scale():
    (scene,), (travel,) = instances((2, 2))
    travel = dataclasses.replace(travel, start_task=np.full((2, 2), np.inf), task_task=np.full((1, 2, 2), np.inf))
    assert Problems.of([scene], [travel]).scale.tolist() == [1.0]


def test_every_scene_needs_its_travel():
    scenes, travels = instances((2, 5), (4, 3))
    with pytest.raises(SettingsError, match="travels holds 1 for 2 scenes"):
        Problems.of(scenes, travels[:1])
    with pytest.raises(SettingsError, match="travels holds 0 for 0 scenes"):
        Problems.of([], [])


def test_random_problems_are_the_same_for_the_same_seed():
    first, again = (random_problems(3, 4, 6, torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first.start_task, again.start_task)
    assert torch.equal(first.capacity, again.capacity)
    expected = (first.starts[:, :, None] - first.tasks[:, None]).norm(dim=3)
    assert torch.allclose(first.start_task, expected, atol=1e-4)


@pytest.mark.parametrize(("drones", "tasks"), [(10, 20), (3, 7), (5, 5)])
def test_random_capacities_hold_all_tasks(drones, tasks):
    capacity = random_capacities(500, drones, tasks, torch.Generator().manual_seed(0))
    assert bool((capacity.sum(dim=1) >= tasks).all())
    usual = -(-tasks // drones) + 1
    share = float((capacity == usual).all(dim=1).float().mean())
    assert 0.4 < share < 0.75
