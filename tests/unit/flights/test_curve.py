"""Curves: values, derivatives, length, time changes, validation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from flockopt import Curve, Flight, SettingsError, Visit

RNG = np.random.default_rng(4)
BREAKPOINTS = np.array([0.5, 1.5, 1.75, 4.0])
CURVE = Curve(BREAKPOINTS, RNG.normal(size=(3, 3, 8)))


@pytest.mark.parametrize("order", range(5))
def test_values_equal_numpys_polynomials(order):
    times = np.linspace(0.5, 4.0, 57)
    for t, value in zip(times, CURVE(times, order), strict=True):
        piece = min(int(np.searchsorted(BREAKPOINTS, t, side="right")) - 1, 2)
        local = t - BREAKPOINTS[piece]
        polynomials = [np.polynomial.Polynomial(axis) for axis in CURVE.coefficients[piece]]
        expected = [(axis.deriv(order) if order else axis)(local) for axis in polynomials]
        np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9)


def test_shapes_follow_the_times():
    assert CURVE(1.0).shape == (3,)
    assert CURVE([1.0, 2.0]).shape == (2, 3)
    assert CURVE(np.ones((4, 5))).shape == (4, 5, 3)


def test_it_holds_still_outside_its_pieces():
    np.testing.assert_allclose(CURVE([-9.0, 0.0]), np.tile(CURVE(0.5), (2, 1)))
    np.testing.assert_allclose(CURVE([4.0, 99.0]), np.tile(CURVE(4.0), (2, 1)))
    assert not CURVE([0.0, 99.0], 1).any()
    assert CURVE(4.0, 1).any()


def test_derivatives_beyond_the_degree_vanish():
    assert not CURVE(1.0, 8).any()
    assert not Curve([0.0, 1.0], np.ones((1, 3, 1)))(0.5, 2).any()


def test_length_is_the_integral_of_speed():
    smooth = Curve(BREAKPOINTS, CURVE.coefficients * 0.3 ** np.arange(8))
    expected = sum(
        quad(lambda t: np.linalg.norm(smooth(t, 1)), a + 1e-12, b - 1e-12, limit=200)[0] for a, b in pairwise(BREAKPOINTS)
    )
    assert smooth.length == pytest.approx(expected, rel=1e-6)


def test_a_straight_line_has_its_length():
    line = Curve([1.0, 3.0], np.array([[[0.0, 3.0], [0.0, 4.0], [0.0, 0.0]]]))
    assert line.length == pytest.approx(10.0, rel=1e-12)
    assert (line.start_time, line.end_time, line.duration) == (1.0, 3.0, 2.0)


def test_shifting_and_stretching_keep_the_path():
    later, slower = CURVE.shifted(2.0), CURVE.stretched(3.0)
    times = np.linspace(0.5, 4.0, 31)
    np.testing.assert_allclose(later(times + 2.0), CURVE(times), atol=1e-9)
    np.testing.assert_allclose(slower(times * 3.0), CURVE(times), atol=1e-9)
    np.testing.assert_allclose(slower(times[:-1] * 3.0, 2), CURVE(times[:-1], 2) / 9, atol=1e-9)
    assert slower.length == pytest.approx(CURVE.length)


def test_a_flight_shifts_its_visits_too():
    flight = Flight(CURVE, (Visit("t1", 1.5),)).shifted(0.25)
    assert flight.visits == (Visit("t1", 1.75),)
    assert flight.curve.start_time == 0.75


def test_degree():
    assert CURVE.at_most_degree(7)
    assert not CURVE.at_most_degree(6)
    assert Curve([0, 1], np.concatenate([np.ones((1, 3, 2)), np.zeros((1, 3, 9))], axis=2)).at_most_degree(1)


def test_arrays_are_copied_and_read_only():
    breakpoints = np.array([0.0, 1.0])
    curve = Curve(breakpoints, np.ones((1, 3, 2)))
    breakpoints[1] = 9.0
    assert curve.end_time == 1.0
    with pytest.raises(ValueError, match="read-only"):
        curve.coefficients[0] = 0


@pytest.mark.parametrize(
    ("breakpoints", "coefficients", "field"),
    [
        ([0, 1], np.ones((1, 2, 4)), "coefficients"),
        ([0, 1], np.ones((3, 4)), "coefficients"),
        ([0], np.ones((0, 3, 4)), "coefficients"),
        ([0, 1], np.ones((1, 3, 0)), "coefficients"),
        ([0, 1, 2], np.ones((1, 3, 4)), "breakpoints"),
        ([0, 0], np.ones((1, 3, 4)), "breakpoints"),
        ([1, 0], np.ones((1, 3, 4)), "breakpoints"),
        ([-1, 0], np.ones((1, 3, 4)), "breakpoints"),
        ([0, np.nan], np.ones((1, 3, 4)), "coefficients"),
        ([0, 1], np.full((1, 3, 4), np.inf), "coefficients"),
    ],
)
def test_malformed_curves_are_refused(breakpoints, coefficients, field):
    with pytest.raises(SettingsError) as caught:
        Curve(breakpoints, coefficients)
    assert caught.value.field == field
