"""The distance model, against distances computed in other ways."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from flockopt.geometry.distances import bounding_boxes, distances, surface_normals
from flockopt.geometry.kernels import segment_distances
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.parts import obstacle_table

OBSTACLES = (
    Box("b", (1.0, 2.0, 3.0), (4.0, 2.0, 6.0), 0.7),
    Cylinder("c", (-3.0, 1.0, 2.0), 0.8, 4.0),
    Sphere("s", (0.0, -4.0, 1.0), 1.5),
)
TABLE = obstacle_table(OBSTACLES)


def rooms(obstacle, point):
    """Numbers that are all >= 0 exactly in the solid, smooth in the point."""
    x, y, z = np.asarray(point) - obstacle.center
    if isinstance(obstacle, Sphere):
        return [obstacle.radius**2 - x * x - y * y - z * z]
    if isinstance(obstacle, Cylinder):
        return [obstacle.radius**2 - x * x - y * y, obstacle.height / 2 - z, obstacle.height / 2 + z]
    cos, sin = np.cos(obstacle.yaw), np.sin(obstacle.yaw)
    local, halves = np.array([cos * x + sin * y, cos * y - sin * x, z]), np.array(obstacle.size) / 2
    return [*(halves - local), *(halves + local)]


def nearest_distance(obstacle, point):
    """Distance to the solid, as a convex program."""
    solid = {"type": "ineq", "fun": lambda q: rooms(obstacle, q)}
    found = minimize(lambda q: np.sum((q - point) ** 2), obstacle.center, method="SLSQP", constraints=solid, tol=1e-14)
    return np.sqrt(found.fun)


@pytest.mark.parametrize("index", range(3))
def test_outside_distances_agree_with_a_numeric_minimum(index):
    points = np.random.default_rng(7).uniform(-6, 6, (40, 3))
    for point in points:
        if min(rooms(OBSTACLES[index], point)) < 0:
            assert distances(TABLE, point)[0, index] == pytest.approx(nearest_distance(OBSTACLES[index], point), abs=1e-6)


@pytest.mark.parametrize("index", range(3))
def test_the_sign_tells_inside_from_outside(index):
    points = np.random.default_rng(3).uniform(-5, 6, (4000, 3))
    expected = np.array([min(rooms(OBSTACLES[index], point)) >= 0 for point in points])
    assert expected.any()
    np.testing.assert_array_equal(distances(TABLE, points)[:, index] <= 0, expected)


def test_known_values():
    table = obstacle_table([Box("b", (0, 0, 0), (2, 4, 6)), Cylinder("c", (0, 0, 0), 1, 2), Sphere("s", (0, 0, 0), 2)])
    points = [(0, 0, 0), (1, 0, 0), (4, 6, 3), (0, 0, 5), (0.5, 0, 0.9)]
    expected = [[-1, -1, -2], [0, 0, -1], [5, np.hypot(np.hypot(4, 6) - 1, 2), np.sqrt(61) - 2], [2, 4, 3]]
    expected.append([-0.5, -0.1, np.hypot(0.5, 0.9) - 2])
    np.testing.assert_allclose(distances(table, points), expected, atol=1e-12)


def test_distances_are_one_lipschitz():
    rng = np.random.default_rng(11)
    a, b = rng.uniform(-6, 6, (2, 5000, 3))
    change = np.abs(distances(TABLE, a) - distances(TABLE, b))
    assert (change <= np.linalg.norm(a - b, axis=1)[:, None] + 1e-12).all()


def test_segments_agree_with_dense_sampling():
    rng = np.random.default_rng(5)
    starts, ends = rng.uniform(-6, 6, (2, 60, 3))
    along = np.linspace(0, 1, 2001)[:, None]
    sampled = np.array([distances(TABLE, p + along * (q - p)).min(axis=0) for p, q in zip(starts, ends, strict=True)])
    exact = segment_distances(TABLE, starts, ends)
    step = np.linalg.norm(ends - starts, axis=1)[:, None] / 2000
    assert (exact <= sampled + 1e-8).all()
    assert (exact >= sampled - step).all()


def test_a_thin_wall_between_samples_is_found():
    wall = obstacle_table([Box("w", (0, 0, 0), (1e-6, 10, 10))])
    assert segment_distances(wall, (-100.0, 0.3, 0.2), (57.0, 0.3, 0.2))[0, 0] <= 0


def test_segments_of_no_length():
    point = np.array([4.0, 4.0, 4.0])
    np.testing.assert_allclose(segment_distances(TABLE, point, point), distances(TABLE, point), atol=1e-12)


def test_normals_point_away_and_have_length_one():
    points = np.random.default_rng(9).uniform(-6, 6, (200, 3))
    points = points[(distances(TABLE, points) > 0.01).all(axis=1)]
    normals = surface_normals(TABLE, points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-6)
    for k in range(3):
        foot = points - distances(TABLE, points)[:, [k]] * normals[:, k]
        np.testing.assert_allclose(distances(TABLE, foot)[:, k], 0.0, atol=1e-5)


def test_bounding_boxes_are_tight():
    boxes = bounding_boxes(TABLE)
    points = np.random.default_rng(13).uniform(-6, 8, (40000, 3))
    solid = distances(TABLE, points) <= 0
    for k in range(3):
        lower, upper = points[solid[:, k]].min(axis=0), points[solid[:, k]].max(axis=0)
        assert (boxes[k, 0] <= lower).all()
        assert (boxes[k, 1] >= upper).all()
        assert (lower - boxes[k, 0] < 0.5).all()
        assert (boxes[k, 1] - upper < 0.5).all()


def test_no_obstacles_give_empty_tables():
    table = obstacle_table([])
    assert table.shape == (0, 9)
    assert distances(table, np.zeros((4, 3))).shape == (4, 0)
    assert bounding_boxes(table).shape == (0, 2, 3)
