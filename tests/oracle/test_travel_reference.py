"""Travel against an independent, dense visibility graph: every edge of it is checked with the judge's distances."""

import math

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from flockopt import generate
from flockopt.geometry.distances import BOX, SPHERE, distances
from flockopt.geometry.kernels import segment_distances
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.families.layouts import FAMILIES
from flockopt.scene.parts import obstacle_table
from flockopt.travel.bends import make_features
from flockopt.travel.roadmap import Roadmap
from flockopt.travel.surroundings import blocked_between, surroundings, uneased

LOWER, UPPER = np.zeros(3), np.array([10.0, 10.0, 4.0])
NEED = 0.25
NUM_POINTS = 10


def dense_nodes(table, num_levels, per_side, num_turns=12):
    """Points around every obstacle, grown by the need: columns of corner points, and lines along top and bottom."""
    nodes = []
    for row in table:
        reach = (row[4] + NEED) / math.cos(math.pi / num_turns)
        turns = 2 * math.pi * (np.arange(num_turns) + 0.5) / num_turns
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        if row[0] == SPHERE:
            for tilt in np.linspace(-math.pi / 2, math.pi / 2, 7):
                circle = np.column_stack([math.cos(tilt) * ring, np.full(num_turns, math.sin(tilt))])
                nodes.append(row[1:4] + (row[4] + NEED) / math.cos(math.pi / 9) * circle)
            continue
        if row[0] == BOX:
            corner = NEED / math.cos(math.pi / num_turns) * ring
            outline = np.concatenate([
                corner[(corner * quadrant > 0).all(axis=1)] + row[4:6] * quadrant
                for quadrant in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ])  # fmt: skip
            steps, side = np.linspace(-1, 1, per_side), np.ones(per_side)
            rim = [np.column_stack([sign * side * (row[4] + NEED), steps * row[5]]) for sign in (-1, 1)]
            rim += [np.column_stack([steps * row[4], sign * side * (row[5] + NEED)]) for sign in (-1, 1)]
            rim = np.concatenate([outline, *rim])
        else:
            outline = reach * ring
            rim = outline
        turn = np.array([[row[7], row[8]], [-row[8], row[7]]])
        tall = row[6] + NEED
        for height in np.linspace(-tall, tall, num_levels):
            nodes.append(np.column_stack([outline @ turn + row[1:3], np.full(len(outline), row[3] + height)]))
        for height in (-tall, tall):
            nodes.append(np.column_stack([rim @ turn + row[1:3], np.full(len(rim), row[3] + height)]))
    nodes = np.concatenate(nodes)
    inside = ((nodes >= LOWER) & (nodes <= UPPER)).all(axis=1)
    return nodes[inside & (distances(table, nodes).min(axis=1) >= NEED - 1e-9)]


def reference_lengths(table, points, num_levels, per_side):
    """(P, P) lengths of shortest paths over the dense nodes."""
    places = np.concatenate([points, dense_nodes(table, num_levels, per_side)])
    first, second = np.triu_indices(len(places), 1)
    clear = np.ones(len(first), dtype=bool)
    for row in table:  # most pairs are blocked by an early obstacle: check only those still clear
        left = np.flatnonzero(clear)
        clear[left] = segment_distances(row[None], places[first[left]], places[second[left]])[:, 0] >= NEED - 1e-9
    first, second = first[clear], second[clear]
    weights = np.linalg.norm(places[first] - places[second], axis=1)
    graph = csr_matrix((weights, (first, second)), shape=(len(places), len(places)))
    return dijkstra(graph, directed=False, indices=np.arange(len(points)))[:, : len(points)]


def free_points(table, seed):
    rng = np.random.default_rng(seed)
    points = np.empty((0, 3))
    while len(points) < NUM_POINTS:
        point = rng.uniform(LOWER + 0.3, UPPER - 0.3)
        if distances(table, point).min() > NEED + 0.01:
            points = np.vstack([points, point])
    return points


def forest(seed):
    rng = np.random.default_rng(seed)
    heights = rng.uniform(1, 4, 6)
    return [
        Cylinder(f"c{k}", (*rng.uniform(1.5, 8.5, 2), height / 2), rng.uniform(0.4, 1.0), height)
        for k, height in enumerate(heights)
    ]


def city(seed):
    rng = np.random.default_rng(seed)
    heights = rng.uniform(0.5, 4, 6)
    return [
        Box(f"b{k}", (*rng.uniform(1.5, 8.5, 2), height / 2), (*rng.uniform(0.5, 3, 2), height), rng.uniform(-3, 3))
        for k, height in enumerate(heights)
    ]


def bubbles(seed):
    rng = np.random.default_rng(seed)
    return [Sphere(f"s{k}", rng.uniform((1.5, 1.5, 0.5), (8.5, 8.5, 3.5)), rng.uniform(0.5, 1.4)) for k in range(7)]


def walls_with_openings(seed):
    """Two walls across the space: a door in one, a window in the other."""
    rng = np.random.default_rng(seed)
    door, window = rng.uniform(2, 8, 2)
    sill, lintel = 1.2, 2.4
    pieces = []
    for name, x, middle, low, high in (("door", 3.5, door, 0.0, 2.2), ("window", 6.5, window, sill, lintel)):
        spans = [(-1.0, middle - 0.6, 0.0, 4.0), (middle + 0.6, 11.0, 0.0, 4.0), (middle - 0.6, middle + 0.6, high, 4.0)]
        spans += [(middle - 0.6, middle + 0.6, 0.0, low)] if low > 0 else []
        for k, (left, right, bottom, top) in enumerate(spans):
            center = (x, (left + right) / 2, (bottom + top) / 2)
            pieces.append(Box(f"{name}{k}", center, (0.2, right - left, top - bottom)))
    return pieces


@pytest.mark.parametrize(
    ("make", "num_levels", "per_side"), [(forest, 7, 7), (city, 7, 7), (bubbles, 7, 7), (walls_with_openings, 31, 25)]
)
def test_lengths_are_within_a_percent_of_a_dense_visibility_graph(make, num_levels, per_side):
    ratios = []
    for seed in range(2):
        table = obstacle_table(make(seed))
        points = free_points(table, seed)
        ours = Roadmap(table, NEED, (LOWER, UPPER)).legs(points, np.ones((NUM_POINTS, NUM_POINTS), bool))
        reference = reference_lengths(table, points, num_levels, per_side)
        np.testing.assert_array_equal(np.isfinite(ours.lengths), np.isfinite(reference))
        i, j = ours.pairs.T
        ratios.append(ours.lengths[i, j] / reference[i, j])
    ratios = np.concatenate(ratios)
    assert len(ratios) >= 8
    assert 0.99 <= ratios.mean() <= 1.01
    assert ratios.max() <= 1.06


@pytest.mark.parametrize("make", [forest, city, walls_with_openings])
def test_lengths_do_not_depend_on_where_the_scene_lies_or_which_way_it_faces(make):
    table = obstacle_table(make(3))
    points = free_points(table, 3)
    wanted = np.ones((NUM_POINTS, NUM_POINTS), dtype=bool)
    lengths = Roadmap(table, NEED, (LOWER, UPPER)).legs(points, wanted).lengths
    quarter, shift = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([100.0, -50.0, 7.0])
    turned = table.copy()
    turned[:, 1:4] = table[:, 1:4] @ quarter + shift
    turned[:, 7], turned[:, 8] = -table[:, 8], table[:, 7]
    corners = np.sort([LOWER @ quarter + shift, UPPER @ quarter + shift], axis=0)
    moved = Roadmap(turned, NEED, corners).legs(points @ quarter + shift, wanted).lengths
    np.testing.assert_allclose(moved, lengths, rtol=0.01)
    assert abs(moved.sum() / lengths.sum() - 1) < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_single_queries_agree_with_the_matrix(seed):
    table = obstacle_table([*forest(seed), *bubbles(seed)])
    points = free_points(table, seed)
    roadmap = Roadmap(table, NEED, (LOWER, UPPER))
    lengths = roadmap.legs(points, np.ones((NUM_POINTS, NUM_POINTS), dtype=bool)).lengths
    singles = [[roadmap.path(p, q)[0] for q in points] for p in points]
    np.testing.assert_allclose(singles, lengths, rtol=0.02)
    assert np.sum(singles) == pytest.approx(lengths.sum(), rel=2e-3)


@pytest.mark.parametrize("family", FAMILIES)
def test_no_way_is_longer_than_one_over_the_same_bends(family):
    """40 scenes of each family: every line between two bends is looked at, tangent or not."""
    for seed in range(40):
        scene = generate(family, drones=3, tasks=7, seed=seed, size=(12.0, 12.0, 4.0))
        points = np.vstack([scene.starts, scene.task_positions])
        need, bounds = float(scene.radii[0]) + scene.clearance, (scene.bounds.lower, scene.bounds.upper)
        ours = Roadmap(scene.obstacle_table, need, bounds).legs(points, np.ones((10, 10), dtype=bool))
        space = scene.free_space(need)
        nodes = np.ascontiguousarray(np.vstack([points, make_features(space).position]))
        pairs = np.stack(np.triu_indices(len(nodes), 1), axis=1)
        pairs = pairs[~blocked_between(surroundings(space), uneased(len(nodes)), nodes, pairs)]
        weights = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
        graph = csr_matrix((weights, pairs.T), shape=(len(nodes), len(nodes)))
        reference = dijkstra(graph, directed=False, indices=np.arange(10))[:, :10]
        too_long = np.argwhere(ours.lengths > 1.001 * reference + 1e-9)
        assert not len(too_long), (scene.name, too_long[0], ours.lengths[tuple(too_long[0])], reference[tuple(too_long[0])])
