"""Slices of motions: the same places as the curve's, and boxes that nothing leaves."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt.certificate.motion_slices import SLICES_PER_PIECE, motion, relative_slices, slices, taylor_shift
from flockopt.flights import Curve


def random_curve(rng, pieces=3, start=0.7):
    """Pieces that join in position only: what a judge must bear."""
    times = start + np.concatenate([[0.0], np.cumsum(rng.uniform(0.3, 2.0, pieces))])
    terms = rng.normal(size=(pieces, 3, 8)) / np.diff(times)[:, None, None] ** np.arange(8)
    curve = Curve(times, terms)
    for k in range(1, pieces):
        terms[k, :, 0] = np.polynomial.polynomial.polyval(times[k] - times[k - 1], terms[k - 1].T)
    return Curve(curve.breakpoints, terms)


def place(parts, s, since):
    return taylor_shift(parts.terms[s], since)[:, 0]


@pytest.mark.parametrize("seed", range(5))
def test_slices_cover_the_curve_and_stay_in_their_boxes(seed):
    rng = np.random.default_rng(seed)
    curve = random_curve(rng)
    parts = slices(motion(curve, (0.0, 0.0, 0.0), curve.end_time + 1.0))
    assert parts.middles[0] - parts.halves[0] == pytest.approx(0.0)
    assert parts.middles[-1] + parts.halves[-1] == pytest.approx(curve.end_time + 1.0)
    np.testing.assert_allclose((parts.middles + parts.halves)[:-1], (parts.middles - parts.halves)[1:])
    boxes = parts.boxes()
    for s in range(len(parts.middles)):
        for share in np.linspace(-0.999, 0.999, 9):
            since = share * parts.halves[s]
            here = place(parts, s, since)
            np.testing.assert_allclose(here, curve(parts.middles[s] + since), atol=1e-9)
            assert (boxes[s, 0] - 1e-12 <= here).all()
            assert (here <= boxes[s, 1] + 1e-12).all()


def test_boxes_shrink_with_the_square_of_the_slice():
    rng = np.random.default_rng(0)
    parts = slices(motion(random_curve(rng, pieces=1, start=0.0), (0.0, 0.0, 0.0), 0.0))
    assert len(parts.middles) == SLICES_PER_PIECE
    box = parts.boxes()
    for s in range(len(parts.middles)):
        places = np.array([place(parts, s, share * parts.halves[s]) for share in np.linspace(-1, 1, 201)])
        assert (box[s, 1] - box[s, 0] <= 1.2 * (places.max(axis=0) - places.min(axis=0)) + 0.05).all()


@pytest.mark.parametrize("seed", range(5))
def test_relative_motion_is_the_difference(seed):
    rng = np.random.default_rng(100 + seed)
    one, other = random_curve(rng), random_curve(rng, pieces=2, start=0.0)
    end, axes = max(one.end_time, other.end_time), np.array([0.5, 0.5, 2.0])
    parts = relative_slices(motion(one, (0, 0, 0), end), motion(other, (0, 0, 0), end), axes)
    assert np.sum(2 * parts.halves) == pytest.approx(end)
    for s in range(len(parts.middles)):
        since = rng.uniform(-0.99, 0.99) * parts.halves[s]
        time = parts.middles[s] + since
        np.testing.assert_allclose(place(parts, s, since), (one(time) - other(time)) / axes, atol=1e-9)


def test_a_parked_drone_stays_where_it_starts():
    whole = motion(None, (1.0, 2.0, 3.0), 5.0)
    assert (whole.times[0], whole.times[-1]) == (0.0, 5.0)
    np.testing.assert_array_equal(slices(whole).boxes(), np.broadcast_to([[1.0, 2.0, 3.0]], (SLICES_PER_PIECE, 2, 3)))
