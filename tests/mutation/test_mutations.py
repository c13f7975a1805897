"""A valid plan broken in one way fails the clause that is about it: 1,000 random mutations, none missed."""

import numpy as np
import pytest

from flockopt.certificate.judge import certify
from tests.mutation.mutations import MUTATIONS, mutate
from tests.mutation.valid_plans import lane_scene, plan_of_lanes

KINDS = ("two-ended-forest", "ng-route", "ng-route-any-end", "held-karp-forest", "rooted-forest")


def valid_case(seed):
    rng = np.random.default_rng(seed)
    scene = lane_scene(rng, lanes=int(rng.integers(3, 6)))
    return scene, *plan_of_lanes(scene, rng, KINDS[seed % 3]), rng


@pytest.mark.parametrize("seed", range(10))
def test_valid_plans_are_certified_and_a_hundred_mutations_each_are_caught(seed):
    scene, plan, travel, rng = valid_case(seed)
    assert certify(scene, plan, travel=travel).failed == ()
    for _ in range(100):
        name, mutated, clause = mutate(scene, plan, rng)
        failed = certify(scene, mutated, travel=travel).failed
        assert clause in {other.name for other in failed}, f"{name} passed: {failed}"
        assert next(other.detail for other in failed if other.name == clause)


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.__name__)
def test_every_mutation_finds_an_occasion_and_is_caught(mutation):
    caught = 0
    for seed in range(4):
        scene, plan, travel, rng = valid_case(seed)
        result = mutation(scene, plan, rng)
        if result is not None:
            mutated, clause = result
            assert not certify(scene, mutated, travel=travel)[clause].holds
            caught += 1
    assert caught


def test_smooth_mutations_break_nothing_else():
    scene, plan, travel, rng = valid_case(3)
    for mutation in MUTATIONS:
        if mutation.__name__ in {"move_anchor", "hurry", "jump", "wrong_start", "never_rest", "mistime_visit"}:
            mutated, clause = mutation(scene, plan, rng)
            failed = {other.name for other in certify(scene, mutated, travel=travel).failed}
            assert failed <= {clause, "visits"}, mutation.__name__
