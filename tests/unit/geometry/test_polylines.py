"""Polylines thinned and measured, against plain forms of both."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt.geometry.polylines import polyline_length, thinned


def plainly_thinned(points, tolerance):
    """Douglas and Peucker's recursion as they wrote it."""
    if len(points) < 3:
        return points
    chord = points[-1] - points[0]
    offset = points[1:-1] - points[0]
    share = np.clip(offset @ chord / max(float(chord @ chord), 1e-12), 0.0, 1.0)
    gaps = np.linalg.norm(offset - share[:, None] * chord, axis=1)
    worst = int(gaps.argmax())
    if gaps[worst] <= tolerance:
        return points[[0, -1]]
    head, tail = plainly_thinned(points[: worst + 2], tolerance), plainly_thinned(points[worst + 1 :], tolerance)
    return np.vstack([head[:-1], tail])


@pytest.mark.parametrize("size", [1, 2, 3, 10, 60])
@pytest.mark.parametrize("spread", [0.01, 0.2, 1.0])
def test_as_the_plain_recursion(size, spread):
    rng = np.random.default_rng(size)
    for _ in range(20):
        points = np.linspace([0.0, 0, 0], [5.0, 1, 0], size) + rng.normal(0.0, spread, (size, 3))
        np.testing.assert_array_equal(thinned(points, 0.05), plainly_thinned(points, 0.05))


def test_a_loop_keeps_its_farthest_points():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.0, 0, 0]])
    np.testing.assert_array_equal(thinned(square, 0.1), square)
    np.testing.assert_array_equal(thinned(np.zeros((4, 3)), 0.1), np.zeros((2, 3)))


def test_a_circle():
    angles = np.linspace(0, 2 * np.pi, 2000)
    circle = 5 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    kept = thinned(circle, 0.1)
    assert 12 <= len(kept) <= 40
    middles = (kept[1:] + kept[:-1]) / 2
    assert (5 - np.linalg.norm(middles, axis=1)).max() <= 0.1 + 1e-3
    assert polyline_length(circle) == pytest.approx(10 * np.pi, rel=1e-5)
    assert polyline_length(circle[:1]) == 0.0
