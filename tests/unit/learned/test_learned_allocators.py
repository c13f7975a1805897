"""The learned allocators with the weights that come with the package."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.allocators import nearest_task
from flockopt import SettingsError
from flockopt.scene.families.generate import generate
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel.compute import compute_travel
from flockopt.travel.travel import straight_travel
from learned.networks.shipped import shipped_path
from tests.instances import random_instance, random_scene

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.networks.weight_files import save_weights  # noqa: E402
from learned.teacher.allocators import ALLOCATORS, load_allocator  # noqa: E402 - torch may be missing
from learned.teacher.refinement import refine  # noqa: E402
from learned.teacher.training.validation import optimal_one_task_cost  # noqa: E402

METHODS = tuple(ALLOCATORS)


@pytest.fixture(scope="module")
def held_out():
    """Scenes of all families that training never saw, with their travel."""
    scenes = [generate(family, drones=10, tasks=20, seed=seed) for family in FAMILIES for seed in range(6)]
    return scenes, [compute_travel(scene) for scene in scenes]


def served(routes):
    return sorted(task for route in routes for task in route)


@pytest.mark.parametrize("method", METHODS)
def test_every_task_that_can_be_is_served_once_within_capacity(held_out, method):
    scenes, travels = held_out
    for scene, allocation in zip(scenes, load_allocator(method).bundles(scenes, travels), strict=True):
        assert len(allocation.routes) == scene.num_drones
        assert len(set(served(allocation.routes))) == len(served(allocation.routes)) == (10 if method == "magnnet" else 20)
        assert max(len(route) for route in allocation.routes) <= (1 if method == "magnnet" else scene.drones[0].capacity)
        assert allocation.steps >= 1
        assert allocation.log_prob <= 0.0


@pytest.mark.parametrize("method", METHODS)
def test_decisions_do_not_depend_on_the_company(held_out, method):
    scenes, travels = (part[:4] for part in held_out)
    other, its_travel = random_instance(np.random.default_rng(0), drones=14, tasks=33, capacity=4)
    allocator = load_allocator(method)
    together = allocator.bundles([*scenes, other], [*travels, its_travel])
    alone = [allocator.bundles([scene], [travel])[0] for scene, travel in zip(scenes, travels, strict=True)]
    assert [allocation.routes for allocation in together[:4]] == [allocation.routes for allocation in alone]
    assert [allocation.steps for allocation in together[:4]] == [allocation.steps for allocation in alone]


def total(travels, allocations):
    return sum(travel.total(allocation.routes) for travel, allocation in zip(travels, allocations, strict=True))


def test_the_teacher_beats_nearest_task_greedy_without_refinement(held_out):
    scenes, travels = held_out
    greedy = sum(travel.total(nearest_task(scene, travel, 0).routes) for scene, travel in zip(scenes, travels, strict=True))
    assert total(travels, load_allocator("teacher").bundles(scenes, travels)) < 0.99 * greedy


def test_magnnet_beats_nearest_task_greedy_and_is_near_the_optimal_assignment(held_out):
    scenes, travels = held_out
    optimal = sum(optimal_one_task_cost(travel.start_task) for travel in travels)
    one_each = [dataclasses.replace(s, drones=tuple(dataclasses.replace(d, capacity=1) for d in s.drones)) for s in scenes]
    greedy = sum(travel.total(nearest_task(scene, travel, 0).routes) for scene, travel in zip(one_each, travels, strict=True))
    cost = total(travels, load_allocator("magnnet").bundles(scenes, travels))
    assert optimal - 1e-6 <= cost < greedy
    assert cost < 1.075 * optimal


def test_the_refined_teacher_is_clearly_under_magnnet_with_bundling(held_out):
    scenes, travels = held_out
    bundling = load_allocator("magnnet-bundling").bundles(scenes, travels)
    teacher = load_allocator("teacher").bundles(scenes, travels)
    refined = refine(scenes, travels, [allocation.routes for allocation in teacher])
    cost = sum(travel.total(routes) for travel, routes in zip(travels, refined, strict=True))
    assert cost < total(travels, teacher)
    assert cost < (1.0 - 0.084) * total(travels, bundling)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("drones", "tasks"), [(1, 4), (3, 1), (25, 120)])
def test_scenes_smaller_and_larger_than_trained_for_work(method, drones, tasks):
    scene, travel = random_instance(np.random.default_rng(1), drones=drones, tasks=tasks, capacity=6)
    (allocation,) = load_allocator(method).bundles([scene], [travel])
    assert len(served(allocation.routes)) == (min(drones, tasks) if method == "magnnet" else tasks)


@pytest.mark.parametrize("method", METHODS)
def test_what_cannot_be_served_is_left(method):
    """Task 0 cannot be reached, task 1 is too heavy for all, and one drone is grounded."""
    scene = random_scene(np.random.default_rng(2), drones=3, tasks=5, capacity=[0, 2, 2])
    heavy = dataclasses.replace(scene.tasks[1], demand=3)
    scene = scene.replace(tasks=(scene.tasks[0], heavy, *scene.tasks[2:]))
    travel = straight_travel(scene)
    start_task, task_task = travel.start_task.copy(), travel.task_task.copy()
    start_task[:, 0] = task_task[:, 0, 1:] = task_task[:, 1:, 0] = np.inf
    travel = dataclasses.replace(travel, start_task=start_task, task_task=task_task)
    (allocation,) = load_allocator(method).bundles([scene], [travel])
    assert allocation.routes[0] == ()
    assert not {0, 1} & set(served(allocation.routes))
    assert method == "magnnet" or served(allocation.routes) == [2, 3, 4]


def test_scenes_without_tasks_get_empty_bundles():
    scene, travel = random_instance(np.random.default_rng(0), drones=2, tasks=0, capacity=3)
    (allocation,) = load_allocator("teacher").bundles([scene], [travel])
    assert (allocation.routes, allocation.steps) == (((), ()), 0)


def test_an_unknown_method_is_refused():
    with pytest.raises(SettingsError, match="method is 'oracle'; must be one of magnnet, magnnet-bundling, teacher"):
        load_allocator("oracle")


def test_the_weights_of_another_method_are_refused():
    with pytest.raises(SettingsError, match="is for 'magnnet'; must be for 'teacher'"):
        load_allocator("teacher", shipped_path("magnnet"))


def test_missing_weights_are_named(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.safetensors cannot be read"):
        load_allocator("teacher", tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    ("tensors", "settings", "words"),
    [({}, {"width": 64}, "holds '.*' of shape None"), ({}, {"width": "wide"}, "width is 'wide'"), ({}, {}, "width is None")],
)
def test_weights_that_do_not_fit_are_named(tmp_path, tensors, settings, words):
    save_weights(tmp_path / "odd.safetensors", tensors, "teacher", settings)
    with pytest.raises(SettingsError, match=words):
        load_allocator("teacher", tmp_path / "odd.safetensors")


def test_shipped_weights_are_small():
    assert sum(shipped_path(method).stat().st_size for method in ("teacher", "magnnet")) < 1_000_000
