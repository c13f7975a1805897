"""Two searches and a brute-force one on the same grid: Dijkstra's costs, A*'s ways, scipy's shortest paths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra as scipy_dijkstra

from flockopt import compute_travel, generate
from flockopt.flights.waypoints import leg_clear
from flockopt.geometry.distances import distances
from flockopt.geometry.free_space import free_space
from flockopt.geometry.kernels import segment_distances
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.families.layouts import FAMILIES
from learned.paths.voxel_search import astar, center_of, dijkstra, make_grid, moves_of
from learned.paths.voxels import VoxelSettings, voxel_oracle
from tests.flights import drone, make_scene

OBSTACLES = (
    Cylinder("c", (1.5, 1.2, 1), 0.4, 1.0),
    Box("b", (3.0, 2.0, 0.8), (0.3, 2.4, 1.6), 0.4),
    Sphere("s", (1, 3, 1), 0.5),
)
NEED = 0.22


def small_space():
    scene = make_scene([drone(0, (9, 9, 3))], [], OBSTACLES)
    return free_space(scene.obstacle_table, NEED, (np.zeros(3), np.array([4.3, 4.0, 2.1])))


def brute_force_matrix(space, grid):
    """All steps between neighbouring voxels whose whole segment keeps its distance, with their lengths in voxels."""
    voxels = [
        voxel for voxel in np.ndindex(*grid.shape) if all(0 < at < top - 1 for at, top in zip(voxel, grid.shape, strict=True))
    ]
    number = {voxel: index for index, voxel in enumerate(np.ndindex(*grid.shape))}
    rows, columns, costs = [], [], []
    inside = set(voxels)
    for voxel in voxels:
        for move in grid.moves:
            other = tuple(int(at) for at in np.add(voxel, move))
            if other not in inside:
                continue
            ends = grid.lower + grid.side * np.array([voxel, other])
            if segment_distances(space.table, ends[:1], ends[1:]).min() >= NEED - 1e-9:
                rows.append(number[voxel])
                columns.append(number[other])
                costs.append(float(np.linalg.norm(move)))
    size = int(np.prod(grid.shape))
    return csr_matrix((costs, (rows, columns)), shape=(size, size))


@pytest.mark.parametrize("connectivity", [6, 26])
def test_costs_equal_scipys_on_a_grid_made_by_brute_force(connectivity):
    space = small_space()
    grid = make_grid(space, 0.4, connectivity)
    expected = scipy_dijkstra(brute_force_matrix(space, grid))
    free = np.flatnonzero(grid.is_free)
    assert 100 < len(free) < 450
    for source in free[::37]:
        np.testing.assert_allclose(dijkstra(grid, source, free), expected[source, free], atol=1e-9)


@pytest.mark.parametrize("connectivity", [6, 26])
def test_astar_ways_cost_what_dijkstra_says_and_take_free_steps_only(connectivity):
    space = small_space()
    grid = make_grid(space, 0.2, connectivity)
    rng = np.random.default_rng(0)
    free, found = np.flatnonzero(grid.is_free), 0
    cost_of = {int(stride): float(cost) for stride, cost in zip(grid.strides, grid.costs, strict=True)}
    for source, target in rng.choice(free, (40, 2)):
        cost = dijkstra(grid, source, np.array([target]))[0]
        way = astar(grid, source, target)
        assert (len(way) == 0) == np.isinf(cost)
        if len(way):
            found += 1
            assert (way[0], way[-1]) == (source, target)
            assert sum(cost_of[int(stride)] for stride in np.diff(way)) == pytest.approx(cost, abs=1e-9)
            centers = np.array([center_of(grid, voxel) for voxel in way])
            assert distances(space.table, centers).min() >= NEED
    assert found > 30


def test_a_step_and_its_reverse_are_free_together():
    for connectivity in (6, 26):
        grid, moves = make_grid(small_space(), 0.3, connectivity), moves_of(connectivity)
        np.testing.assert_array_equal(moves, -moves[::-1])
        assert len(moves) == connectivity
        for voxel in np.flatnonzero(grid.is_free):
            for move, stride in enumerate(grid.strides):
                back = grid.steps[voxel + stride] >> (connectivity - 1 - move) & 1
                assert (grid.steps[voxel] >> move & 1) == back


@pytest.mark.parametrize("family", FAMILIES)
def test_more_directions_make_ways_no_longer_and_any_angle_none_longer_than_those(family):
    scene = generate(family, drones=2, tasks=5, seed=3)
    travel = compute_travel(scene)
    six, many = (voxel_oracle(scene, VoxelSettings(connectivity)) for connectivity in (6, 26))
    for name in ("start_task", "task_task"):
        any_angle, coarse, fine = (getattr(each, name) for each in (travel, six.travel, many.travel))
        assert np.isfinite(coarse).all()
        assert (fine <= coarse + 1e-9).all()
        # any-angle paths bend around sampled features: among walls with windows they are not always the shortest
        assert (any_angle <= fine * 1.01).all()


@pytest.mark.parametrize("connectivity", [6, 26])
@pytest.mark.parametrize("family", FAMILIES)
def test_legs_are_clear_and_as_long_as_the_oracle_says(family, connectivity):
    scene = generate(family, drones=2, tasks=4, seed=5)
    oracle = voxel_oracle(scene, VoxelSettings(connectivity))
    for target in range(scene.num_tasks):
        for drone_index, origin, expected in [
            (0, -1, oracle.travel.start_task[0, target]),
            (1, (target + 1) % 4, oracle.travel.task_task[0, (target + 1) % 4, target]),
        ]:
            leg = oracle.leg(drone_index, origin, target)
            assert leg_clear(scene, drone_index, leg)
            assert np.linalg.norm(np.diff(leg, axis=0), axis=1).sum() == pytest.approx(expected, abs=1e-6)
            np.testing.assert_array_equal(leg[-1], scene.task_positions[target])
