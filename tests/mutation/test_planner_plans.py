"""Plans of the real pipeline, broken in one way each: the judge must name the clause."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import certify, compute_travel, generate, plan
from tests.mutation.mutations import mutate

MUTATIONS_PER_FAMILY = 100


@pytest.mark.parametrize("family", ["forest", "corridor", "warehouse", "rooms", "city"])
def test_no_mutation_of_a_certified_plan_passes(family: str):
    scene = generate(family, drones=5, tasks=12, seed=3)
    travel = compute_travel(scene)
    result = plan(scene)
    assert result.status == "certified"
    rng = np.random.default_rng(11)
    for _ in range(MUTATIONS_PER_FAMILY):
        name, broken, clause = mutate(scene, result, rng)
        failed = [fault.name for fault in certify(scene, broken, travel=travel).failed]
        assert clause in failed, f"{name} should fail {clause}; failed are {failed}"
