"""A bound stays below the optimum whatever its vector holds, and does not depend on how the scene is written down."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flockopt.bundles import Bound
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.bundles.exact.exact import solve_exact
from flockopt.certificate.proof import recompute_bound
from flockopt.scene import Scene, Task
from flockopt.travel.travel import straight_travel
from tests.instances import random_instance, random_scene, with_cut_legs
from tests.known.brute_force import least_travel

#: Metres, for sums of legs in another order.
ROUNDING_M = 1e-9

seeds = st.integers(0, 2**32 - 1)


def small_scene(seed):
    rng = np.random.default_rng(seed)
    tasks = int(rng.integers(1, 7))
    return random_scene(
        rng, drones=3, tasks=tasks, capacity=[tasks, 3 * tasks, 2], ends=bool(rng.integers(2)), demands=bool(rng.integers(2))
    )


@settings(max_examples=200, deadline=None)
@given(seed=seeds)
def test_no_scene_has_a_bound_above_its_optimum(seed):
    """Ends, ranges, classes, legs that are cut, drones and tasks of any weight or none at all."""
    rng = np.random.default_rng(seed)
    drones, tasks = int(rng.integers(1, 5)), int(rng.integers(0, 7))
    capacity = [1] * drones if rng.integers(3) == 0 else rng.choice([0, 1, 2, 3, 4, 9], drones).tolist()
    scene, travel = random_instance(
        rng, drones=drones, tasks=tasks, capacity=capacity, ends=bool(rng.integers(3)), demands=bool(rng.integers(2)),
        max_distance=30.0 if rng.integers(3) == 0 else None,
    )  # fmt: skip
    if drones > 1 and rng.integers(3) == 0:
        both = np.concatenate([travel.task_task, 1.3 * travel.task_task])
        travel = dataclasses.replace(travel, task_task=both, drone_class=np.arange(drones) % 2)
    if rng.integers(4) == 0:
        travel = with_cut_legs(rng, travel, 0.2)
    optimum = least_travel(scene, travel)
    for kind in ("fast", "tight", "exact"):
        for upper in {None, optimum if optimum < np.inf else None}:
            proof = lower_bound(scene, travel, bound=kind, upper=upper)
            assert recompute_bound(scene, travel, proof) == pytest.approx(proof.value, rel=1e-9, abs=ROUNDING_M)
            assert proof.value <= optimum + ROUNDING_M * max(1.0, proof.value)
        if kind != "fast" and tasks and max(capacity) == 1 and scene.drones[0].max_distance is None:
            assert proof.value == pytest.approx(optimum, rel=1e-9)  # an assignment problem


@settings(max_examples=150, deadline=None)
@given(
    seed=seeds,
    kind=st.sampled_from(["fast", "tight", "exact"]),
    tampering=st.sampled_from(["noise", "scale", "spike", "swap", "random"]),
)
def test_a_tampered_vector_proves_nothing_above_the_optimum(seed, kind, tampering):
    scene = small_scene(seed)
    travel, rng = straight_travel(scene), np.random.default_rng(seed + 1)
    optimum = least_travel(scene, travel)
    proof = lower_bound(scene, travel, bound=kind, upper=optimum)
    assert recompute_bound(scene, travel, proof) <= optimum + ROUNDING_M
    dual = proof.dual.copy()
    if tampering == "noise":
        dual += rng.normal(0, 1, dual.shape)
    elif tampering == "scale":
        dual *= rng.uniform(-2, 5)
    elif tampering == "spike" and dual.size:
        dual[rng.integers(dual.size)] += 10 ** rng.uniform(-3, 6)
    elif tampering == "swap":
        rng.shuffle(dual)
    else:
        dual = rng.uniform(-5, 25, dual.shape)
    tampered = Bound(proof.kind, 2 * optimum, dual)
    assert recompute_bound(scene, travel, tampered) <= optimum * (1 + 1e-9) + ROUNDING_M


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_optimum_and_forest_do_not_depend_on_order_or_place(seed):
    scene = small_scene(seed)
    rng = np.random.default_rng(seed)
    order = rng.permutation(scene.num_tasks)
    turned = scene.replace(tasks=tuple(scene.tasks[j] for j in order), drones=scene.drones[::-1])
    shifted = moved(scene, np.array([3.0, -2.0, 1.0]))
    value = solve_exact(scene, straight_travel(scene)).proven
    for other in (turned, shifted):
        assert solve_exact(other, straight_travel(other)).proven == pytest.approx(value, rel=1e-7)
        fast = lower_bound(other, straight_travel(other), bound="fast").value
        assert fast == pytest.approx(lower_bound(scene, straight_travel(scene), bound="fast").value, rel=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_tighter_bounds_are_not_lower_and_the_exact_bound_is_below_what_it_starts(seed):
    scene = small_scene(seed)
    travel = straight_travel(scene)
    fast, tight = (lower_bound(scene, travel, bound=kind).value for kind in ("fast", "tight"))
    result = solve_exact(scene, travel)
    assert fast <= tight + ROUNDING_M
    assert result.bound.value <= result.proven + ROUNDING_M


def moved(scene: Scene, by: np.ndarray) -> Scene:
    """The whole scene somewhere else."""

    def shift(point):
        return point if point is None or isinstance(point, str) else tuple((np.array(point) + by).tolist())

    bounds = dataclasses.replace(scene.bounds, lower=shift(scene.bounds.lower), upper=shift(scene.bounds.upper))
    drones = tuple(dataclasses.replace(drone, start=shift(drone.start), end=shift(drone.end)) for drone in scene.drones)
    tasks = tuple(Task(task.id, shift(task.position), task.demand) for task in scene.tasks)
    return scene.replace(bounds=bounds, drones=drones, tasks=tasks)
