"""Flights put together from the parts of several plans."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import Curve, Flight, Visit
from sim.mission.stitching import Leg, stitched


def line(begin: float, end: float, start: float, speed: float, *visits: Visit) -> Flight:
    """Along x at a speed; two axes stand still."""
    return Flight(Curve(np.array([begin, end]), np.array([[[start, speed], [1.0, 0.0], [2.0, 0.0]]])), visits)


def test_a_single_plan_is_flown_as_it_is():
    flight = line(0.0, 2.0, 0.0, 1.0)
    assert stitched([Leg(flight)]) is flight
    assert stitched([Leg(None)]) is None


def test_the_second_plan_begins_where_the_first_is_cut_off():
    first = line(0.0, 4.0, 0.0, 1.0, Visit("a", 1.0), Visit("b", 3.0))
    second = line(0.0, 2.0, 2.5, 2.0, Visit("c", 1.0))
    whole = stitched([Leg(first, 0.0, 2.5), Leg(second, 2.5)])
    np.testing.assert_allclose(whole.curve([0.0, 1.0, 2.4, 2.5, 3.5, 9.0])[:, 0], [0.0, 1.0, 2.4, 2.5, 4.5, 6.5])
    assert whole.visits == (Visit("a", 1.0), Visit("c", 3.5))


def test_a_drone_rests_between_plans_and_while_it_has_no_part_in_one():
    first, third = line(0.0, 1.0, 0.0, 1.0), line(1.0, 2.0, 1.0, 3.0)
    whole = stitched([Leg(first, 0.0, 2.0), Leg(None, 2.0, 5.0), Leg(third, 5.0)])
    np.testing.assert_allclose(whole.curve([0.5, 1.0, 3.0, 5.9, 6.5, 7.0])[:, 0], [0.5, 1.0, 1.0, 1.0, 2.5, 4.0])
    assert (whole.curve.start_time, whole.curve.end_time) == (0.0, 7.0)


def test_a_plan_dropped_before_it_begins_leaves_nothing():
    assert stitched([Leg(line(1.0, 2.0, 0.0, 1.0, Visit("a", 2.0)), 0.0, 0.5)]) is None


def test_pieces_of_different_degrees_go_together():
    cubic = Flight(Curve(np.array([0.0, 1.0]), np.tile([0.0, 0.0, 3.0, -2.0], (1, 3, 1))))
    whole = stitched([Leg(line(0.0, 1.0, -1.0, 1.0), 0.0, 1.0), Leg(cubic, 1.0)])
    assert whole.curve.coefficients.shape == (2, 3, 4)
    assert whole.curve(2.0)[0] == pytest.approx(1.0)
