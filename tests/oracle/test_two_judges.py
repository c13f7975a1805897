"""The closed forms and python-fcl judge many plans, valid and broken between samples, and must agree."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import generate, plan
from flockopt.certify import certify
from flockopt.travel import compute_travel
from tests.mutation.mutations import cross, dip, hurry, move_anchor
from tests.mutation.valid_plans import lane_scene, plan_of_lanes

#: Both answers are lower bounds that are this tight.
TIGHT_M = 3e-7

#: Nearer to the limit than this the judges may differ.
DOUBTFUL_M = 1e-4


def compare(scene, flown, travel):
    """Whether the two agree; the clauses that fail."""
    closed = certify(scene, flown, travel=travel)
    measured = certify(scene, flown, travel=travel, engine="fcl")
    for one, other in zip(closed.clauses, measured.clauses, strict=True):
        if one.name not in ("clearance", "separation"):
            assert one == other
            continue
        if abs(one.margin) > DOUBTFUL_M:
            assert one.holds == other.holds, (one, other)
        depth = min(drone.radius for drone in scene.drones) + scene.clearance
        if one.name == "separation" or one.margin > -depth:  # inside an obstacle only the closed form knows how deep
            assert one.margin == pytest.approx(other.margin, abs=TIGHT_M), (one, other)
        if not one.holds:
            assert (one.detail != "", other.detail != "") == (True, True)
    return {clause.name for clause in measured.failed}


@pytest.mark.parametrize("seed", range(20))
def test_they_agree_on_plans_by_hand_and_on_broken_ones(seed):
    rng = np.random.default_rng(seed)
    scene = lane_scene(rng, lanes=int(rng.integers(3, 6)))
    valid, travel = plan_of_lanes(scene, rng)
    assert compare(scene, valid, travel) == set()
    for mutation, clause in ((dip, "clearance"), (cross, "separation"), (hurry, None), (move_anchor, None)):
        for _ in range(4 if clause else 1):
            result = mutation(scene, valid, rng)
            if result is not None:
                failed = compare(scene, result[0], travel)
                assert clause is None or clause in failed


@pytest.mark.parametrize("family", ["forest", "corridor", "warehouse", "rooms", "city"])
def test_they_agree_on_plans_of_the_families_and_on_broken_ones(family):
    scene = generate(family, drones=4, tasks=8, seed=1)
    flown, travel = plan(scene, bound="fast"), compute_travel(scene)
    assert compare(scene, flown, travel) == set()
    rng = np.random.default_rng(5)
    for mutation, clause in ((dip, "clearance"), (cross, "separation")):
        result = mutation(scene, flown, rng)
        if result is not None:
            assert clause in compare(scene, result[0], travel)
