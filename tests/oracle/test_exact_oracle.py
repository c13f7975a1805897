"""The exact method and a CP-SAT arc model find the same optima; the solver and the judge compute the same bounds."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

pytest.importorskip("highspy", reason="highspy comes with the extra 'solvers'")
pytest.importorskip("ortools", reason="OR-Tools comes with the extra 'solvers'")

from benchmarks.allocation_cases import uniform_scene
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.bundles.exact.exact import solve_exact
from flockopt.certificate.proof import recompute_bound
from flockopt.travel.travel import straight_travel
from tests.instances import random_instance, random_scene, with_cut_legs
from tests.oracle.arc_model import least_travel

#: Each of at most a dozen legs is rounded to a micrometre.
ROUNDING_M = 1e-5


def instance(seed):
    """Three drones and ten tasks; ends, demands, longest routes and cut legs now and then, as the seed says."""
    rng = np.random.default_rng(1000 + seed)
    demands = seed % 3 == 1
    capacity = [int(c) for c in rng.integers(6, 10, 3)] if demands else [int(c) for c in rng.integers(3, 6, 3)]
    longest = float(rng.uniform(25, 50)) if seed % 5 == 4 else None
    scene = random_scene(rng, drones=3, tasks=10, capacity=capacity, ends=seed % 2 == 0, demands=demands, max_distance=longest)
    travel = straight_travel(scene)
    return scene, with_cut_legs(rng, travel, 0.3) if seed % 7 == 6 else travel


@cache
def solved(seed):
    return solve_exact(*instance(seed))


@pytest.mark.parametrize("seed", range(50))
def test_both_exact_methods_find_the_same_optimum(seed):
    scene, travel = instance(seed)
    expected, result = least_travel(scene, travel), solved(seed)
    if math.isinf(expected):
        assert result.status == "infeasible" and result.proven == math.inf
    else:
        assert result.status == "optimal"
        assert travel.total(result.bundles.routes) == pytest.approx(expected, abs=ROUNDING_M)
        assert recompute_bound(scene, travel, result.bound) <= expected + ROUNDING_M


def test_a_fleet_that_presolve_got_wrong():
    """Frozen: HiGHS 1.14's presolve claimed 96.0 m here; its own check then failed the run."""
    scene = uniform_scene(10, 40, 82)
    result = solve_exact(scene, straight_travel(scene))
    assert result.status == "optimal" and result.proven == pytest.approx(99.97758791683759, rel=1e-9)


def test_some_of_the_instances_are_infeasible():
    count = sum(solved(seed).status == "infeasible" for seed in range(50))
    assert 3 <= count <= 25


@pytest.mark.parametrize("bound", ["fast", "tight", "exact"])
@pytest.mark.parametrize("seed", range(8))
def test_the_judge_finds_the_value_that_the_solver_claims(seed, bound):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(
        rng, drones=4, tasks=int(rng.integers(1, 16)), capacity=[0, 3, 5, 9], ends=seed % 2 == 0, demands=seed % 3 == 0
    )
    if seed % 4 == 3:  # two classes of drones
        matrices = np.concatenate([travel.task_task, 1.2 * travel.task_task])
        travel = dataclasses.replace(travel, task_task=matrices, drone_class=np.array([0, 1, 0, 1]))
    proof = lower_bound(scene, travel, bound=bound)
    assert recompute_bound(scene, travel, proof) == pytest.approx(proof.value, rel=1e-9)


def test_the_judge_agrees_on_a_fleet_of_many_tasks():
    scene, travel = random_instance(np.random.default_rng(0), drones=8, tasks=40, capacity=6)
    for bound in ("fast", "tight", "exact"):
        proof = lower_bound(scene, travel, bound=bound)
        assert recompute_bound(scene, travel, proof) == pytest.approx(proof.value, rel=1e-9)
