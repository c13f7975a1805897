"""The compiled twins agree with the numpy forms."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt.geometry import kernels
from flockopt.geometry.distances import distances
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.parts import obstacle_table


def random_table(rng, count=12):
    kinds = []
    for k in range(count):
        center = tuple(rng.uniform(-5, 5, 3))
        sizes = tuple(rng.uniform(0.2, 4, 3))
        box, cylinder = Box(f"b{k}", center, sizes, rng.uniform(-4, 4)), Cylinder(f"c{k}", center, *sizes[:2])
        kinds.append((box, cylinder, Sphere(f"s{k}", center, 1))[k % 3])
    return obstacle_table(kinds)


@pytest.fixture
def rng():
    return np.random.default_rng(42)


def test_point_distances_equal_numpys(rng):
    table, points = random_table(rng), rng.uniform(-8, 8, (500, 3))
    twins = np.array([[kernels.point_distance(row, *point) for row in table] for point in points])
    np.testing.assert_allclose(twins, distances(table, points), rtol=0, atol=1e-12)
    assert (twins < 0).any()


def test_gradients_equal_differences(rng):
    table, points = random_table(rng), rng.uniform(-6, 6, (300, 3))
    step, checked = 1e-6, 0
    for point in points:
        for row in table:
            gradient = np.array(kernels.point_gradient(row, *point))
            ahead, behind = ([kernels.point_distance(row, *(point + s * axis)) for axis in np.eye(3)] for s in (step, -step))
            difference = (np.array(ahead) - behind) / (2 * step)
            if abs(np.linalg.norm(difference) - 1) < 1e-6:  # away from ridges, where it has several subgradients
                np.testing.assert_allclose(gradient, difference, atol=1e-5)
                checked += 1
    assert checked > 3000


def test_gradients_are_subgradients_everywhere(rng):
    """Convexity: the tangent plane at any point, a ridge or a centre included, stays below the distance."""
    table = random_table(rng)
    others = rng.uniform(-8, 8, (200, 3))
    values = distances(table, others)
    for k, row in enumerate(table):
        for offset in ((0.0, 0.0, 0.0), (0.0, 0.0, row[6]), (0.1, 0.0, 0.0), (5.0, 5.0, 5.0)):
            point = row[1:4] + np.array(offset)
            plane = kernels.point_distance(row, *point) + (others - point) @ np.array(kernels.point_gradient(row, *point))
            assert (plane <= values[:, k] + 1e-9).all()


def test_segments_stop_early_only_when_they_may(rng):
    table = random_table(rng)
    starts, ends = rng.uniform(-8, 8, (2, 80, 3))
    exact = kernels.segment_distances(table, starts, ends)
    for p, q, row_of_exact in zip(starts, ends, exact, strict=True):
        for row, least in zip(table, row_of_exact, strict=True):
            enough = kernels.segment_distance(row, p, q, 0.5, -np.inf)
            assert enough <= least + 1e-8
            assert enough >= min(least, 0.5) - 1e-8
            too_little = kernels.segment_distance(row, p, q, np.inf, 0.5)
            assert too_little >= least - 1e-8
            assert too_little <= max(least, 0.5) + 1e-8


@pytest.mark.parametrize(
    ("p", "q", "near"),
    [
        ((-2, 0.5, 0.5), (2, 0.5, 0.5), True),  # through
        ((-2, 1.4, 0.5), (2, 1.4, 0.5), True),  # through what the reach adds
        ((-2, 1.6, 0.5), (2, 1.6, 0.5), False),  # beside
        ((-2, 0.5, 0.5), (-1, 0.5, 0.5), False),  # short of it
        ((-2, 0, 0.5), (0.5, 4, 0.5), False),  # past the corner
        ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5), True),  # a point inside
    ],
)
def test_segments_near_a_box(p, q, near):
    box = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert kernels.segment_near_box(box, 0.5, np.array(p, dtype=float), np.array(q, dtype=float)) == near
