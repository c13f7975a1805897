"""Closed-form nearness against the distances of `flockopt.geometry.kernels`."""

import numpy as np
import pytest

from flockopt.geometry.free_space import free_space
from flockopt.geometry.kernels import SEGMENT_TOLERANCE_M, segment_distances
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.parts import obstacle_table
from flockopt.travel.blocking import blocker, too_near
from flockopt.travel.surroundings import blocked_between, surroundings, uneased


def random_table(rng):
    return obstacle_table([
        Box("b", rng.uniform(-1, 1, 3), rng.uniform(0.1, 3, 3), rng.uniform(-3, 3)),
        Cylinder("c", rng.uniform(-1, 1, 3), rng.uniform(0.1, 2), rng.uniform(0.1, 3)),
        Sphere("s", rng.uniform(-1, 1, 3), rng.uniform(0.1, 2)),
    ])  # fmt: skip


def random_segments(rng, number=100):
    """Some level, some upright, some along an axis, some of no length."""
    p, q = rng.uniform(-4, 4, (number, 3)), rng.uniform(-4, 4, (number, 3))
    q[:20, 2] = p[:20, 2]
    q[20:30, :2] = p[20:30, :2]
    q[30:40, 1:] = p[30:40, 1:]
    q[40:45] = p[40:45]
    return p, q


@pytest.mark.parametrize("seed", range(20))
def test_too_near_is_what_the_distance_says(seed):
    rng = np.random.default_rng(seed)
    table, need = random_table(rng), rng.uniform(0.01, 1.5)
    p, q = random_segments(rng)
    exact = segment_distances(table, p, q)
    answers = np.array([[too_near(table, k, need, *a, *b) for k in range(3)] for a, b in zip(p, q, strict=True)])
    decided = np.abs(exact - need) > 3 * SEGMENT_TOLERANCE_M
    np.testing.assert_array_equal(answers[decided], (exact < need)[decided])
    assert answers.any() and not answers.all()


@pytest.mark.parametrize("seed", range(20))
def test_segments_just_clear_of_an_obstacle_are_told_from_those_just_too_near(seed):
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    p, q = random_segments(rng)
    exact = segment_distances(table, p, q)
    for k in range(3):
        for row in np.flatnonzero(exact[:, k] > 0.01):
            assert not too_near(table, k, exact[row, k] - 1e-8, *p[row], *q[row])
            assert too_near(table, k, exact[row, k] + 1e-8, *p[row], *q[row])


@pytest.mark.parametrize("seed", range(10))
def test_a_blocker_is_found_exactly_where_there_is_one_whatever_the_guess(seed):
    rng = np.random.default_rng(seed)
    table = np.concatenate([random_table(rng) for _ in range(3)])
    needs = rng.uniform(0.01, 0.4, len(table))
    space = free_space(table, needs, (np.full(3, -9.0), np.full(3, 9.0)))
    p, q = random_segments(rng)
    near = segment_distances(table, p, q) < needs
    for guess in (-1, 0, 5):
        for a, b, row in zip(p, q, near, strict=True):
            found = blocker(space, a, b, guess)
            assert row[found] if found >= 0 else not row.any()
    pairs = np.stack([np.arange(len(p)), np.arange(len(p)) + len(p)], axis=1)
    around, points = surroundings(space), np.concatenate([p, q])
    np.testing.assert_array_equal(blocked_between(around, uneased(len(points)), points, pairs), near.any(axis=1))


def test_a_need_of_nothing_still_keeps_out_of_the_inside():
    table = obstacle_table([Box("b", (0, 0, 0), (2, 2, 2))])
    assert too_near(table, 0, 0.0, -3.0, 0.0, 0.0, 3.0, 0.0, 0.0)
    assert not too_near(table, 0, 0.0, -3.0, 1.0, 0.0, 3.0, 1.0, 0.0)
