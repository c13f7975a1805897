"""The closed forms and python-fcl judge many plans, valid and broken between samples, and must agree."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import generate, plan
from flockopt.certificate import Cost, Plan
from flockopt.certificate.fcl_engine import least_separation
from flockopt.certificate.judge import certify
from flockopt.flights import Curve, Flight
from flockopt.geometry.continuous import least_separation as closed_least_separation
from flockopt.scene import Bounds, Drone, Scene
from flockopt.travel.compute import compute_travel
from tests.mutation.mutations import cross, dip, hurry, move_anchor, mutate
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(50))
def test_they_agree_on_a_thousand_plans_half_of_them_broken(seed):
    rng = np.random.default_rng(1000 + seed)
    for _ in range(10):
        scene = lane_scene(rng, lanes=int(rng.integers(3, 6)))
        valid, travel = plan_of_lanes(scene, rng)
        assert compare(scene, valid, travel) == set()
        _, mutated, clause = mutate(scene, valid, rng)
        failed = compare(scene, mutated, travel)
        assert clause in failed


def flying_polynomial(rng):
    """Three smooth pieces of degree 7 through random places in a room of 4 m, a second or so each."""
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.6, 1.4, 3))])
    ends = rng.uniform(-2.0, 2.0, (4, 2, 3)) * np.array([1.0, 0.5])[:, None]  # place and velocity
    ends[[0, -1], 1] = 0.0
    terms = np.zeros((3, 3, 8))
    for k, span in enumerate(np.diff(times)):
        step, start, stop = ends[k + 1, 0] - ends[k, 0], ends[k, 1] * span, ends[k + 1, 1] * span
        # the septic with zero acceleration and jerk at both ends
        for power, (a, b, c) in enumerate([(35, -20, -15), (-84, 45, 39), (70, -36, -34), (-20, 10, 10)], start=4):
            terms[k, :, power] = (a * step + b * start + c * stop) / span**power
        terms[k, :, 0], terms[k, :, 1] = ends[k, 0], ends[k, 1]
    return Curve(times, terms)


def places(curve, times):
    """The curve at rising times, (3, T): a piece at a time, which is ten times as fast as calling it."""
    local = np.split(times, np.searchsorted(times, curve.breakpoints[1:]))
    pieces = [
        np.polynomial.polynomial.polyval(part - begin, terms.T)
        for part, begin, terms in zip(local, curve.breakpoints[:-1], curve.coefficients, strict=False)
    ]
    ends = np.repeat(curve(curve.end_time)[:, None], len(local[-1]), axis=1)
    return np.concatenate([*pieces, ends], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_pairs_that_pass_are_apart_at_ten_kilohertz(seed):
    """10,000 pairs; those that one judge passes, the other one does, and samples never come nearer than allowed."""
    rng, passed = np.random.default_rng(2000 + seed), 0
    axes = np.array([0.4, 0.4, 0.8])
    for _ in range(500):
        one, other = flying_polynomial(rng), flying_polynomial(rng)
        end = max(one.end_time, other.end_time)
        pair = (one.breakpoints, one.coefficients, other.breakpoints, other.coefficients)
        closed, _ = closed_least_separation(*pair, axes, 0.0, end, 1e-7, np.inf)
        drones = tuple(Drone(name, (float(k), 0.0, 0.0), 1, 0.1, 9.0, 99.0, 999.0) for k, name in enumerate(("d0", "d1")))
        scene = Scene("pair", Bounds((-9, -9, -9), (9, 9, 9)), drones, separation=0.4, separation_z=0.8)
        flights = {"d0": Flight(one), "d1": Flight(other)}
        plan_of_pair = Plan("pair", scene.sha256, "by hand", "uncertified", {}, {}, flights, Cost(0, 0, None, None, end))
        found = least_separation(scene, plan_of_pair)
        assert found.margin == pytest.approx(closed, abs=TIGHT_M)
        if closed >= 0.0:
            passed += 1
            times = np.arange(0.0, end, 1e-4)
            sampled = np.linalg.norm((places(one, times) - places(other, times)) / axes[:, None], axis=0).min()
            assert sampled >= 1.0 + min(closed, found.margin) / axes[0] - 1e-9
    assert 50 < passed < 450
