"""The closed-form fly-through of a polyline."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt.flights import Curve
from flockopt.flights.laws.fly_through import first_outside, fly_polyline
from flockopt.geometry.free_space import free_space

LIMITS = np.array([2.0, 4.0, 30.0])
ZERO = np.zeros(3)


def random_polyline(seed: int):
    rng = np.random.default_rng(seed)
    legs = int(rng.integers(1, 9))
    points = rng.uniform(0, [20, 20, 5], (legs + 1, 3)) * rng.choice([1.0, 0.1, 0.01])
    rest_s = np.where(rng.random(legs + 1) < 0.2, rng.choice([0.0, 0.7]), -1.0)
    rest_s[0], rest_s[-1] = -1.0, 0.0
    return points, rest_s


@pytest.mark.parametrize("seed", range(60))
def test_passes_every_point_within_limits(seed: int):
    points, rest_s = random_polyline(seed)
    breakpoints, coefficients, times, owners = fly_polyline(
        points, rest_s, np.full(len(points) - 1, 2.0), LIMITS, ZERO, ZERO, 0
    )
    curve = Curve(breakpoints, coefficients)
    np.testing.assert_allclose(curve(times), points, atol=1e-9)
    samples = np.linspace(0, curve.end_time, 3001)
    for order, limit in enumerate(LIMITS, start=1):
        assert np.linalg.norm(curve(samples, order), axis=1).max() <= limit * (1 + 1e-9)
    assert len(owners) == curve.num_pieces
    assert (np.diff(owners) >= 0).all()


@pytest.mark.parametrize("seed", range(30))
def test_position_velocity_and_acceleration_are_continuous(seed: int):
    points, rest_s = random_polyline(seed)
    curve = Curve(*fly_polyline(points, rest_s, np.full(len(points) - 1, 2.0), LIMITS, ZERO, ZERO, 0)[:2])
    spans = np.diff(curve.breakpoints)
    for order, tolerance in ((0, 1e-9), (1, 1e-8), (2, 1e-6)):
        coefficients = curve._derivatives(order)
        ends = np.einsum("kad,kd->ka", coefficients, spans[:, None] ** np.arange(coefficients.shape[2]))
        np.testing.assert_allclose(ends[:-1], coefficients[1:, :, 0], atol=tolerance)
        if order:
            np.testing.assert_allclose(ends[-1], 0.0, atol=tolerance)


def test_rest_holds_still_for_its_time():
    points = np.array([[0.0, 0, 1], [3, 0, 1], [3, 3, 1]])
    breakpoints, coefficients, times, _ = fly_polyline(
        points, np.array([-1.0, 1.5, 0.5]), np.full(2, 2.0), LIMITS, ZERO, ZERO, 0
    )
    curve = Curve(breakpoints, coefficients)
    np.testing.assert_allclose(curve(times[1] + np.linspace(0, 1.5, 7)), np.tile(points[1], (7, 1)), atol=1e-12)
    assert curve.end_time == pytest.approx(times[2] + 0.5)


def test_starts_from_a_moving_state():
    velocity, acceleration = np.array([1.0, -0.5, 0.2]), np.array([0.5, 1.0, 0.0])
    points = np.array([[0.0, 0, 1], [4, 1, 1], [8, 0, 1]])
    curve = Curve(*fly_polyline(points, np.array([-1.0, -1, 0]), np.full(2, 2.0), LIMITS, velocity, acceleration, 0)[:2])
    np.testing.assert_allclose(curve(0.0, 1), velocity)
    np.testing.assert_allclose(curve(0.0, 2), acceleration)
    samples = np.linspace(0, curve.end_time, 3001)
    for order, limit in enumerate(LIMITS, start=1):
        assert np.linalg.norm(curve(samples, order), axis=1).max() <= limit * (1 + 1e-5)


def test_flying_through_is_faster_than_stopping():
    points = np.cumsum(np.random.default_rng(3).uniform(1, 3, (7, 3)), axis=0)
    caps = np.full(6, 2.0)
    through = fly_polyline(points, np.array([-1.0] * 6 + [0.0]), caps, LIMITS, ZERO, ZERO, 0)[0][-1]
    stopping = fly_polyline(points, np.zeros(7), caps, LIMITS, ZERO, ZERO, 0)[0][-1]
    assert through < 0.9 * stopping


def test_a_cap_slows_its_leg():
    points = np.array([[0.0, 0, 1], [6, 0, 1]])
    curve = Curve(*fly_polyline(points, np.array([-1.0, 0]), np.array([0.5]), LIMITS, ZERO, ZERO, 0)[:2])
    assert np.linalg.norm(curve(np.linspace(0, curve.end_time, 500), 1), axis=1).max() <= 0.5 + 1e-9


def test_first_outside_names_the_piece():
    points = np.array([[1.0, 1, 1], [5, 1, 1], [5, 5, 1]])
    breakpoints, coefficients, _, _ = fly_polyline(points, np.array([-1.0, -1, 0]), np.full(2, 2.0), LIMITS, ZERO, ZERO, 0)
    roomy = first_outside(free_space(np.empty((0, 9)), 0.0, (np.zeros(3), np.full(3, 9.0))), breakpoints, coefficients)
    tight = first_outside(
        free_space(np.empty((0, 9)), 0.0, (np.zeros(3), np.array([5.0, 9.0, 9.0]))), breakpoints, coefficients
    )
    assert roomy == -1
    piece = Curve(breakpoints[tight : tight + 2], coefficients[tight : tight + 1])
    assert piece(np.linspace(piece.start_time, piece.end_time, 200))[:, 0].max() > 5.0
