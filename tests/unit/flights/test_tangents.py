import numpy as np
import pytest

from flockopt import Box, Cylinder, Sphere
from flockopt.flights.smoothing.stages import Stage
from flockopt.flights.smoothing.tangents import part_weights, tangent_rows
from flockopt.geometry.continuous import curve_clear
from flockopt.geometry.distances import distances
from flockopt.geometry.free_space import free_space
from flockopt.scene.parts import obstacle_table

OBSTACLES = (Box("b", (0, 0, 0), (2, 1, 3), 0.4), Cylinder("c", (3, 1, 0), 0.7, 2.0), Sphere("s", (-2, 2, 0.5), 0.8))
TABLE = obstacle_table(OBSTACLES)
FAR = np.full(3, 50.0)
SPACE = free_space(TABLE, 0.2, (-FAR, FAR))


def stage_around(rng):
    """Four pieces that wind between the obstacles."""
    places = np.array([[-4, -2, 0.0], [-1.5, -1.6, 0.3], [1.9, -1.2, 0.2], [2.0, 2.5, -0.3], [-1, 3.5, 0.0]])
    states = np.zeros((5, 3, 3))
    states[:, 0] = places + rng.normal(scale=0.05, size=places.shape)
    states[1:-1, 1] = (places[2:] - places[:-2]) / 4
    return Stage(np.full(4, 2.0), states, ())


def test_parts_are_parts():
    rng = np.random.default_rng(0)
    control, parts = rng.normal(size=6), part_weights(6)
    from math import comb

    def value(points, t):
        return sum(comb(5, i) * t**i * (1 - t) ** (5 - i) * points[i] for i in range(6))

    for part, (start, width) in {0: (0, 1), 1: (0, 0.5), 2: (0.5, 0.5), 4: (0.25, 0.25), 14: (0.875, 0.125)}.items():
        for t in (0.0, 0.3, 1.0):
            assert value(parts[part] @ control, t) == pytest.approx(value(control, start + t * width))


def test_a_tangent_bounds_the_distance_from_below():
    """What all of this rests on, with the judge's own distances: they are convex."""
    from flockopt.geometry.kernels import point_distance, point_gradient

    rng = np.random.default_rng(1)
    for row in TABLE:
        for x, y in rng.uniform(-5, 5, size=(300, 2, 3)):
            tangent = point_distance(row, *x) + np.dot(point_gradient(row, *x), y - x)
            assert tangent <= distances(row[None], y)[0, 0] + 1e-9


def test_the_given_curve_keeps_to_its_own_inequalities():
    rng = np.random.default_rng(2)
    for _ in range(20):
        stage = stage_around(rng)
        rows, offsets = tangent_rows(stage.control, SPACE, 24, 1.0)
        assert rows.any()
        assert (np.einsum("krai,kai->kr", rows, stage.control) - offsets).min() >= -1e-12


def test_a_curve_that_keeps_to_them_is_clear():
    rng = np.random.default_rng(3)
    clear = blocked = 0
    for _ in range(20):
        stage = stage_around(rng)
        rows, offsets = tangent_rows(stage.control, SPACE, 400, 50.0)
        strict = (np.einsum("krai,kai->kr", rows, stage.control) > offsets + 1e-9).all(axis=1)  # nothing was relaxed
        for scale in (0.02, 0.1, 0.3):
            states = stage.states + rng.normal(scale=scale, size=stage.states.shape)
            other = Stage(stage.durations, states, ())
            keeps = strict & (np.einsum("krai,kai->kr", rows, other.control) >= offsets).all(axis=1)
            for piece in range(4):
                span = other.breakpoints[piece : piece + 2]
                is_clear = curve_clear(SPACE, span - span[0], other.coefficients[piece : piece + 1]) == -1
                assert is_clear or not keeps[piece]
                clear, blocked = clear + keeps[piece], blocked + (not is_clear)
    assert clear > 50
    assert blocked > 5


def test_bounds_are_kept():
    stage = stage_around(np.random.default_rng(4))
    upper = stage.control.max(axis=(0, 2)) + 0.1
    rows, offsets = tangent_rows(stage.control, free_space(TABLE[:0], 0.2, (-FAR, upper)), 12, 0.5)
    moved = stage.control + np.array([0.0, 0.0, 0.11])[:, None]
    assert (np.einsum("krai,kai->kr", rows, stage.control) >= offsets).all()
    assert not (np.einsum("krai,kai->kr", rows, moved) >= offsets).all()


def test_the_tightest_are_kept():
    stage = stage_around(np.random.default_rng(5))
    many = tangent_rows(stage.control, SPACE, 200, 1.0)
    few = tangent_rows(stage.control, SPACE, 5, 1.0)
    margins = [np.einsum("krai,kai->kr", rows, stage.control) - offsets for rows, offsets in (many, few)]
    for rows, kept in zip(*margins, strict=True):
        np.testing.assert_allclose(np.sort(kept), np.sort(rows)[:5], atol=1e-12)
