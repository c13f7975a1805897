"""Free space: one record, of one type whatever it is made from, and what stays in it."""

from __future__ import annotations

import numpy as np
import pytest
from numba import typeof

from flockopt.geometry.distances import bounding_boxes, distances
from flockopt.geometry.free_space import FREE_SPACE, free_space, inside, may_meet, polyline_free, segment_clear, segment_free
from flockopt.geometry.kernels import SEGMENT_TOLERANCE_M, segment_distances
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.parts import obstacle_table
from tests.flights import drone, make_scene

FAR = (np.full(3, -9.0), np.full(3, 9.0))


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


def test_clear_segments_keep_their_needs(rng):
    table = random_table(rng)
    space = free_space(table, rng.uniform(0.0, 0.5, len(table)), FAR)
    starts, ends = rng.uniform(-8, 8, (2, 400, 3))
    least = segment_distances(table, starts, ends)
    clear = np.array([segment_clear(space, p, q) for p, q in zip(starts, ends, strict=True)])
    assert 0 < clear.sum() < len(clear)
    np.testing.assert_array_equal(clear, (least >= space.needs - SEGMENT_TOLERANCE_M).all(axis=1))


def test_free_is_clear_and_within_bounds(rng):
    space = free_space(random_table(rng, 4), 0.2, (np.full(3, -6.0), np.full(3, 6.0)))
    lines = rng.uniform(-6.5, 6.5, (400, 3, 3))
    within = ((lines >= space.lower) & (lines <= space.upper)).all(axis=2)
    np.testing.assert_array_equal([[inside(space, point) for point in line] for line in lines], within)
    clear = np.array([[segment_clear(space, *line[:2]), segment_clear(space, *line[1:])] for line in lines])
    free = np.array([polyline_free(space, line) for line in lines])
    np.testing.assert_array_equal(free, clear.all(axis=1) & within.all(axis=1))
    np.testing.assert_array_equal([segment_free(space, *line[:2]) for line in lines], clear[:, 0] & within[:, :2].all(axis=1))
    assert 0 < free.sum() < clear.all(axis=1).sum()


def test_what_may_not_meet_a_box_is_farther_from_all_of_it_than_it_must(rng):
    space = free_space(random_table(rng), 0.3, FAR)
    apart = 0
    for _ in range(200):
        corners = np.sort(rng.uniform(-8, 8, (2, 3)), axis=0)
        gaps = distances(space.table, rng.uniform(*corners, (50, 3))).min(axis=0)
        for k in range(len(space.table)):
            if not may_meet(space, k, *corners):
                assert gaps[k] >= 0.3
                apart += 1
    assert apart > 500


def test_the_record_has_one_type_whatever_it_is_made_from():
    """So that no compiled function exists twice: a scene's arrays are read-only, others may lie in memory the other way."""
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 9, 1)], (Box("b", (5, 5, 1), (1, 1, 1)), Sphere("s", (2, 8, 1), 0.4)))
    table = np.asfortranarray(scene.obstacle_table)
    spaces = [scene.free_space(0.2), free_space(table, [0.2, 0.2], FAR), free_space(np.empty((0, 9)), 1, FAR)]
    assert {typeof(space) for space in spaces} == {FREE_SPACE}
    np.testing.assert_array_equal(spaces[0].boxes, bounding_boxes(scene.obstacle_table))
    np.testing.assert_allclose(spaces[0].reach, [np.hypot(0.5, 0.5) + 0.2, 0.6])
    spaces[0].table[:] = 0.0  # its own: the scene's stays as it is
    assert scene.obstacle_table.any()
