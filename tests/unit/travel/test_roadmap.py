"""Roadmaps: what they remember, what is added to them, and what lengths depend on."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import compute_travel, generate
from flockopt.geometry.distances import SPHERE, distances
from flockopt.geometry.free_space import free_space
from flockopt.geometry.kernels import segment_distances
from flockopt.scene import Box, Sphere
from flockopt.scene.families.layouts import FAMILIES
from flockopt.scene.parts import obstacle_table
from flockopt.travel import roadmap
from flockopt.travel.bends import make_features
from flockopt.travel.roadmap import Roadmap, roadmap_among
from flockopt.travel.sight import seen_by_features
from flockopt.travel.surroundings import surroundings

NEED = 0.22


def scene_of(family, seed=0, tasks=12):
    return generate(family, drones=3, tasks=tasks, seed=seed, size=(12.0, 12.0, 4.0))


def bounds_of(scene):
    return scene.bounds.lower, scene.bounds.upper


def all_legs(of_roadmap, points):
    return of_roadmap.legs(points, np.ones((len(points), len(points)), dtype=bool))


@pytest.mark.parametrize("family", FAMILIES)
def test_a_length_depends_on_its_two_places_alone(family):
    scene = scene_of(family)
    points, chosen = np.vstack([scene.starts, scene.task_positions]), [9, 2, 5, 0, 13]
    one = Roadmap(scene.obstacle_table, NEED, bounds_of(scene), 0.005)
    whole, part = all_legs(one, points).lengths, all_legs(one, points[chosen]).lengths
    np.testing.assert_array_equal(part, whole[np.ix_(chosen, chosen)])


def test_the_bends_of_a_leg_lead_from_its_first_place_to_its_second():
    scene = scene_of("rooms")
    points = np.vstack([scene.starts, scene.task_positions])
    for order in (slice(None), slice(None, None, -1)):
        legs = all_legs(Roadmap(scene.obstacle_table, NEED, bounds_of(scene)), points[order])
        assert len(legs.pairs) > 50 and (legs.pairs[:, 0] < legs.pairs[:, 1]).all()
        for (i, j), first, last in zip(legs.pairs, legs.offsets[:-1], legs.offsets[1:], strict=True):
            path = np.vstack([points[order][i], legs.bends[first:last], points[order][j]])
            assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(legs.lengths[i, j], abs=1e-9)
            assert segment_distances(scene.obstacle_table, path[:-1], path[1:]).min() >= NEED - 1e-9


@pytest.mark.parametrize("family", FAMILIES)
def test_balls_put_among_known_obstacles_are_as_if_they_had_always_been_there(family):
    rng, scene = np.random.default_rng(3), scene_of(family)
    points = np.vstack([scene.starts, scene.task_positions])
    balls = []
    while len(balls) < 3:
        center = rng.uniform(1.0, 3.0, 3) * np.array([4.0, 4.0, 1.0])
        row = (SPHERE, *center, 0.4, 0.4, 0.4, 1.0, 0.0)
        if distances(np.array([row]), points).min() > NEED + 0.05:
            balls.append(row)
    before = Roadmap(scene.obstacle_table, NEED, bounds_of(scene))
    all_legs(before, points)
    more = all_legs(before.with_balls(np.array(balls)), points)
    anew = all_legs(Roadmap(np.vstack([scene.obstacle_table, balls]), NEED, bounds_of(scene)), points)
    np.testing.assert_allclose(more.lengths, anew.lengths, rtol=2e-3)
    assert (more.lengths >= all_legs(before, points).lengths - 1e-9).mean() > 0.95
    for (i, j), first, last in zip(more.pairs, more.offsets[:-1], more.offsets[1:], strict=True):
        path = np.vstack([points[i], more.bends[first:last], points[j]])
        assert segment_distances(np.vstack([scene.obstacle_table, balls]), path[:-1], path[1:]).min() >= NEED - 1e-9


def test_what_is_known_of_obstacles_is_remembered(monkeypatch):
    scene, made = scene_of("city"), []
    make = roadmap.make_features
    monkeypatch.setattr(roadmap, "make_features", lambda space: made.append(1) or make(space))
    roadmap._roadmap.cache_clear()
    first = compute_travel(scene)
    assert made
    made.clear()
    again = compute_travel(scene.replace(tasks=scene.tasks[2:]))
    assert not made
    np.testing.assert_array_equal(again.start_task, first.start_task[:, 2:])
    table, bounds = scene.obstacle_table, bounds_of(scene)
    assert (
        roadmap_among(table, 0.3, bounds) is roadmap_among(table.copy(), 0.3, bounds) is not roadmap_among(table, 0.31, bounds)
    )


def test_among_many_places_only_near_legs_are_pulled_taut(monkeypatch):
    scene = scene_of("city", tasks=30)
    taut = compute_travel(scene).task_task[0]
    monkeypatch.setattr(roadmap, "MANY_LEGS", 20)
    monkeypatch.setattr(roadmap, "NUM_NEAR", 5)
    some = compute_travel(scene)
    lengths = some.task_task[0]
    is_near = lengths <= np.sort(lengths, axis=1)[:, 5:6]
    np.testing.assert_allclose(lengths[is_near], taut[is_near], rtol=0.03)
    assert (lengths >= taut - 1e-9).all() and (lengths > 1.001 * taut).any() and (lengths <= 1.2 * taut).mean() > 0.95
    for i in range(0, 30, 7):
        for j in range(30):
            path = some.path(0, i, j)
            assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(lengths[i, j], abs=1e-9)
            assert i == j or segment_distances(scene.obstacle_table, path[:-1], path[1:]).min() >= NEED - 1e-9


def test_a_place_nearer_than_the_margin_is_left_with_half_the_room_it_has():
    table = obstacle_table([Box("near", (4, 6, 2), (2, 2, 4)), Box("far", (8, 6, 2), (2, 2, 4))])
    place, other = np.array([3.0 - NEED - 0.01, 6.0, 2.0]), np.array([11.0, 6.0, 2.0])
    with_margin = Roadmap(table, NEED, ((0, 0, 0), (12, 12, 4)), 0.05)
    length, path = with_margin.path(place, other)
    assert np.isfinite(length)
    gaps = segment_distances(table, path[:-1], path[1:]).min(axis=0)
    assert NEED + 0.005 - 1e-9 <= gaps[0] < NEED + 0.05 and gaps[1] >= NEED + 0.05 - 1e-9


def test_lines_along_and_over_a_roof_are_seen_from_its_corners():
    space = free_space(obstacle_table([Box("low", (6, 6, 0.5), (2, 2, 1))]), NEED, ((0, 0, 0), (12, 12, 4)))
    features = make_features(space)
    everybody = np.arange(len(features.position))
    pairs = set(map(tuple, seen_by_features(surroundings(space), features, everybody, False).tolist()))
    corners = np.flatnonzero(features.cap == 1.0)
    edges = np.flatnonzero((features.along[:, 2] == 0.0) & (features.second[:, 2] > 0.0))
    assert len(corners) == 8 and len(edges) >= 4
    assert all((min(c, e), max(c, e)) in pairs for c in corners for e in edges)


def test_pulling_taut_never_lengthens_a_way(monkeypatch):
    scene = generate("forest", drones=10, tasks=40, seed=1)
    points, taken = np.vstack([scene.starts, scene.task_positions]), []
    pull = roadmap.tightened
    monkeypatch.setattr(roadmap, "tightened", lambda *given: taken.append((given, made := pull(*given))) or made)
    all_legs(Roadmap(scene.obstacle_table, NEED, bounds_of(scene), 0.005), points)
    ratios = []
    for (_, _, places, features, pairs, begin, count, chains), (lengths, *_) in taken:
        for pair, first, (many, _), length in zip(pairs, begin, count, lengths, strict=True):
            raw = np.vstack([places[pair[0]], features.position[chains[first : first + many]], places[pair[1]]])
            ratios.append(length / np.linalg.norm(np.diff(raw, axis=0), axis=1).sum())
    assert len(ratios) > 200 and max(ratios) <= 1.0 + 1e-12


def test_a_second_chain_makes_some_ways_shorter(monkeypatch):
    scene = generate("city", drones=5, tasks=25, seed=0)
    points = np.vstack([scene.starts, scene.task_positions])
    both = all_legs(Roadmap(scene.obstacle_table, NEED, bounds_of(scene), 0.005), points).lengths
    find = roadmap.chains_between
    monkeypatch.setattr(roadmap, "chains_between", lambda *given: find(*given[:-1], False))
    one = all_legs(Roadmap(scene.obstacle_table, NEED, bounds_of(scene), 0.005), points).lengths
    assert (both <= one + 1e-9).all() and (both < 0.999 * one).any()


def test_where_no_tangents_lead_on_any_clear_line_does(monkeypatch):
    balls = [(1.372, 1.662, 0.916, 1.192), (1.372, 3.178, 1.523, 0.797), (2.736, 4.237, 1.745, 0.939)]
    balls += [(4.059, 3.821, 2.058, 1.187), (4.899, 3.638, 1.114, 0.859), (4.472, 3.676, 1.589, 0.51)]
    table = obstacle_table([Sphere(f"s{k}", (x, y, z), radius) for k, (x, y, z, radius) in enumerate(balls)])
    place, other, space = (1.293, 1.122, 2.426), (0.347, 0.619, 0.978), ((0, 0, 0), (6, 6, 3))
    length, path = Roadmap(table, 0.2, space).path(place, other)
    assert np.isfinite(length)
    assert segment_distances(table, path[:-1], path[1:]).min() >= 0.2 - 1e-9
    find = Roadmap._chains
    monkeypatch.setattr(
        Roadmap, "_chains", lambda self, eased, points, pairs, _, deadline: find(self, eased, points, pairs, False, deadline)
    )
    assert np.isinf(Roadmap(table, 0.2, space).path(place, other)[0])
