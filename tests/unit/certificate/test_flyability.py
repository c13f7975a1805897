"""The largest thrust and tilt over time against closed forms and dense samples; the clause that judges them."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest

from flockopt import plan
from flockopt.certificate import Plan
from flockopt.certificate.certificate import CLAUSES, FLYABILITY
from flockopt.certificate.flyability import largest_thrust, largest_tilt
from flockopt.certificate.judge import certify
from flockopt.errors import PlanError
from flockopt.flights import Curve
from flockopt.geometry.bernstein import control_points
from flockopt.scene import Scene
from flockopt.scene.scene import GRAVITY_MPS2


def extremes(curve):
    controls = control_points(curve.breakpoints, curve.coefficients, curve.coefficients.shape[2])
    return largest_thrust(curve.breakpoints, controls), largest_tilt(curve.breakpoints, controls)


def constant_acceleration(acceleration, seconds=2.0):
    terms = np.zeros((1, 3, 3))
    terms[0, :, 2] = np.array(acceleration) / 2
    return Curve(np.array([0.0, seconds]), terms)


@pytest.mark.parametrize(
    "acceleration", [(0, 0, 0), (3.0, 0, 0), (0, -2.0, 1.5), (1.0, 2.0, -4.0), (0, 0, 5.0), (8.0, 8.0, -9.0)]
)
def test_constant_accelerations_in_closed_form(acceleration):
    x, y, z = acceleration
    (thrust, _), (tilt, _) = extremes(constant_acceleration(acceleration))
    assert thrust == pytest.approx(max(math.hypot(x, y, z + GRAVITY_MPS2), GRAVITY_MPS2), rel=1e-9)
    assert tilt == pytest.approx(math.atan2(math.hypot(x, y), z + GRAVITY_MPS2), rel=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_random_curves_against_dense_samples(seed):
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.3], 0.3 + np.cumsum(rng.uniform(0.5, 3.0, 4))])
    terms = rng.normal(size=(4, 3, 8)) / np.diff(times)[:, None, None] ** np.arange(8)
    curve = Curve(times, terms * rng.uniform(0.05, 0.4))
    (thrust, thrust_time), (tilt, tilt_time) = extremes(curve)
    samples = np.concatenate([np.linspace(a + 1e-12, b - 1e-12, 20001) for a, b in pairwise(times)])
    sampled = curve(samples, 2) + np.array([0.0, 0.0, GRAVITY_MPS2])
    most = np.linalg.norm(sampled, axis=1).max()
    assert most <= thrust * (1 + 1e-9)
    assert thrust == pytest.approx(max(most, GRAVITY_MPS2), rel=1e-5)
    if sampled[:, 2].min() > 0.0:
        angles = np.arctan2(np.hypot(sampled[:, 0], sampled[:, 1]), sampled[:, 2])
        assert angles.max() <= tilt * (1 + 1e-9)
        assert tilt == pytest.approx(angles.max(), rel=1e-4)
        assert tilt_time == pytest.approx(samples[angles.argmax()], abs=2e-3)
    else:
        assert tilt == math.pi
    assert times[0] <= thrust_time <= times[-1]


def test_free_fall_leaves_nothing_to_lean_on():
    assert extremes(constant_acceleration((0.0, 0.0, -GRAVITY_MPS2)))[1][0] == math.pi
    assert extremes(constant_acceleration((1.0, 0.0, -20.0)))[1][0] == math.pi


def test_a_peak_between_samples_counts():
    """A tilt that lasts a millisecond."""
    bump = np.array([0.0, 0.0, 0.0, 1.0, -3.0, 3.0, -1.0])  # at rest at both ends
    terms = np.zeros((1, 3, 7))
    terms[0, 0] = 1e-6 * bump / 1e-3 ** np.arange(7)
    (_, _), (tilt, time) = extremes(Curve(np.array([5.0, 5.001]), terms))
    local = np.linspace(0, 1, 100001)
    most = np.abs(np.polynomial.polynomial.polyval(local, np.polynomial.polynomial.polyder(bump, 2))).max() * 1e-6 / 1e-6
    assert tilt == pytest.approx(math.atan(most / GRAVITY_MPS2), rel=1e-6)
    assert 5.0 <= time <= 5.001


@pytest.fixture(scope="module")
def able():
    """The example scene with one drone whose abilities are known, and a plan within them."""
    from tests.conftest import TWO_DRONES

    drones = [TWO_DRONES["drones"][0] | {"mass": 0.034, "max_thrust": 0.5, "max_tilt": 0.25}, *TWO_DRONES["drones"][1:]]
    scene = Scene.from_dict(TWO_DRONES | {"drones": drones})
    return scene, plan(scene, bound="fast")


def test_planners_keep_within_the_abilities(able):
    scene, flown = able
    assert flown.status == "certified"
    clause = flown.certificate[FLYABILITY]
    assert [clause.name for clause in flown.certificate.clauses] == [*CLAUSES, FLYABILITY]
    assert 0.0 <= clause.margin < 0.5
    assert clause.drone == scene.drones[0].id
    assert "times the weight" in clause.detail


def limited(scene, flown, **changes):
    """The same flight for a weaker drone."""
    drones = (dataclasses.replace(scene.drones[0], **changes), *scene.drones[1:])
    weaker = scene.replace(drones=drones)
    return certify(weaker, dataclasses.replace(flown, scene_sha256=weaker.sha256))[FLYABILITY]


def test_the_clause_fails_just_beyond_the_limit(able):
    scene, flown = able
    drone = scene.drones[0]
    curve = flown.flights[drone.id].curve
    (thrust, thrust_time), (tilt, _) = extremes(curve)
    assert limited(scene, flown, max_thrust=None, max_tilt=tilt * 1.0001).holds
    broken = limited(scene, flown, max_thrust=None, max_tilt=tilt * 0.999)
    assert not broken.holds
    assert broken.margin == pytest.approx(1 - 1 / 0.999)
    assert "max_tilt" in broken.detail
    assert limited(scene, flown, max_tilt=None, max_thrust=drone.mass * thrust * 1.0001).holds
    broken = limited(scene, flown, max_tilt=None, max_thrust=drone.mass * thrust * 0.999)
    assert not broken.holds
    assert broken.time == pytest.approx(thrust_time)
    assert "max_thrust" in broken.detail


def test_a_mass_alone_reports_without_judging(able):
    clause = limited(*able, max_thrust=None, max_tilt=None)
    assert clause.holds
    assert clause.margin == math.inf
    assert "degrees" in clause.detail


def test_scenes_without_abilities_keep_ten_clauses(scene):
    assert [clause.name for clause in plan(scene, bound="fast").certificate.clauses] == list(CLAUSES)


def test_the_clause_is_read_back(able, tmp_path):
    _, flown = able
    flown.save(tmp_path / "plan.json")
    assert Plan.load(tmp_path / "plan.json").certificate.to_dict() == flown.certificate.to_dict()
    record = flown.to_dict()
    record["certificate"]["clauses"].reverse()
    with pytest.raises(PlanError, match="in this order"):
        Plan.from_dict(record)
