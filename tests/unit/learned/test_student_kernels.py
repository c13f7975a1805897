"""What the student has compiled equals its plain forms: clearance, layout, choice of tries, features, and points."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt import Sphere, generate  # noqa: E402 - torch may be missing
from flockopt.flights.waypoints import leg_clear  # noqa: E402
from flockopt.geometry.free_space import free_space, polyline_free  # noqa: E402
from flockopt.geometry.polylines import thinned  # noqa: E402
from learned.paths.rollout import anchors_of  # noqa: E402
from learned.student.legs import choice  # noqa: E402
from learned.student.legs.layout import CLEAR_SHARE, anchor_places  # noqa: E402
from learned.student.network.leg_frame import leg_frames, sample_features  # noqa: E402
from learned.student.network.rows import Rows, points_of, rows_of  # noqa: E402
from learned.student.scenes.batch import collate  # noqa: E402
from learned.student.scenes.examples import example  # noqa: E402
from tests.student_scenes import random_routes, taught_example, tiny_student  # noqa: E402

FAMILIES = ("forest", "city", "rooms", "warehouse")


@pytest.fixture(scope="module", params=FAMILIES)
def one(request):
    scene = generate(request.param, drones=4, tasks=11, seed=5)
    ball = Sphere("ball", (10.0, 10.0, 2.5), 0.4)
    scene = dataclasses.replace(scene, obstacles=(*scene.obstacles, ball)) if request.param == "city" else scene
    return example(scene, random_routes(scene, 3))


def places_of(one):
    return [(0, int(drone)) for drone in np.flatnonzero(one.blocked.any(axis=1))]


def wavy_ways(one, count=60):
    """Polylines near the straight ways, some of them blocked or out of bounds."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        drone, size = int(rng.integers(4)), int(rng.integers(2, 12))
        first = int(rng.integers(0, 64 - size))
        spread = rng.choice([0.01, 0.2, 1.0])
        yield drone, one.straight[drone, first : first + size] + rng.normal(0.0, spread, (size, 3))


def space_of(scene, drone):
    return scene.free_space(scene.drones[drone].radius + scene.clearance)


def test_ways_are_ranked_as_the_decoder_reads_them(one):
    tolerance, num_clear = 0.05, 0
    for drone, way in wavy_ways(one):
        clear = leg_clear(one.scene, drone, thinned(way, tolerance))
        metres = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
        assert choice.rank(space_of(one.scene, drone), way, tolerance) == pytest.approx(metres if clear else np.inf)
        num_clear += clear
    assert 0 < num_clear < 60


def plain_places(weights, num_samples):
    """The samples of the anchors: rising from the first to the last, spaced by the legs' weights."""
    ideal = np.concatenate([[0.0], np.cumsum(weights)]) / max(float(weights.sum()), 1e-9) * (num_samples - 1)
    ranks = np.arange(len(ideal))
    places = np.maximum.accumulate(np.round(ideal).astype(np.int64) - ranks) + ranks
    return np.minimum(places, num_samples - len(places) + ranks)


def test_samples_are_laid_out_as_plainly(one):
    for drone, route in enumerate(one.routes):
        anchors = anchors_of(one.scene, drone, route)
        legs = list(pairwise(anchors))
        blocked = np.array([not leg_clear(one.scene, drone, np.stack(leg)) for leg in legs])
        lengths = np.linalg.norm(np.diff(anchors, axis=0), axis=1)
        places = plain_places(lengths * np.where(blocked, 1.0, CLEAR_SHARE), 64)
        assert np.array_equal(anchor_places(lengths * np.where(blocked, 1.0, CLEAR_SHARE), 64), places)
        index = np.clip(np.searchsorted(places, np.arange(64)) - 1, 0, None)
        assert np.array_equal(one.leg_index[drone], index) and np.array_equal(one.blocked[drone], blocked[index])
        assert np.array_equal(one.leg_begin[drone], places[index]) and np.array_equal(one.leg_end[drone], places[index + 1])
        assert np.allclose(one.straight[drone, places], anchors, atol=0.0)


def test_legs_that_lead_nowhere_are_laid_out_too():
    scene = generate("forest", drones=1, tasks=2, seed=0)
    start = scene.drones[0].start
    scene = dataclasses.replace(scene, tasks=tuple(dataclasses.replace(task, position=start) for task in scene.tasks))
    laid = example(scene, [(0, 1)])
    assert laid.leg_end.max() == 63 and np.allclose(laid.straight, start)


def test_what_rows_are_told_is_what_the_network_would_see(one):
    student = tiny_student("small")
    batch, places = collate([one]), places_of(one)
    scene, drone = torch.tensor(places).unbind(dim=1)
    ways = batch.ways.rows(scene, drone)
    with torch.inference_mode():
        expected = sample_features(ways, leg_frames(ways), student.settings.nearest_obstacles)[:, 0]
        rows = rows_of(student.settings, student.decide(batch)[1], [one], places)
    assert (rows.features[..., :3] == 0.0).all()
    close = torch.isclose(rows.features[..., 3:], expected, atol=2e-4).all(dim=-1)
    assert close.float().mean() > 0.98  # two obstacles as near as each other may change places
    assert torch.allclose(rows.shares.sum(dim=-1), torch.ones(len(places), student.settings.num_patches))


@pytest.mark.parametrize("config", ["small", "small-regression"])
def test_rows_are_drawn_as_whole_batches_are(one, config):
    student = tiny_student(config)
    batch, places = collate([one]), places_of(one)
    scene, drone = torch.tensor(places).unbind(dim=1)
    noise = torch.randn(2, len(places), 64, 3, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        expected = student.draw(batch, scene, drone, noise, 2).numpy()
        rows = rows_of(student.settings, student.decide(batch)[1], [one], places)
        twice = Rows(*(tensor.repeat(2, *[1] * (tensor.dim() - 1)) for tensor in rows))
        residuals = student.sample(twice, noise.flatten(0, 1), 2).view(noise.shape)
    points = points_of([one], places, residuals)
    assert np.quantile(np.abs(points - expected), 0.98) < 1e-4
    for row, (_, index) in enumerate(places):
        for ends in (one.leg_begin[index], one.leg_end[index]):
            assert np.array_equal(points[0, row, ends], one.straight[index, ends])


def test_the_shortest_clear_try_is_chosen_leg_by_leg():
    taught = taught_example("forest", drones=6, tasks=12, seed=1)
    for _, drone in places_of(taught):
        space = space_of(taught.scene, drone)
        tries = np.stack([taught.straight[drone], taught.target[drone]])
        samples = taught.straight[drone].copy()
        way = taught.leg_end[drone], taught.blocked[drone]
        assert choice.best_legs(space, *way, samples, tries, 0.05)
        assert np.array_equal(samples[taught.blocked[drone]], taught.target[drone][taught.blocked[drone]])
        assert not choice.best_legs(space, *way, samples, tries[:1], 0.05)


def test_a_taut_leg_that_thinning_would_cut_into_an_obstacle_keeps_its_corners():
    """The corner of the taut way is nearer to the chord than the decoder keeps; the drawn way swings out farther."""
    need = 0.2
    table = np.array([[2.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 1.0, 0.0]])  # a sphere
    space = free_space(table, need, (np.full(3, -9.0), np.full(3, 9.0)))
    drawn = np.array([[-3.0, 0.68, 0.0], [0.0, 0.8, 0.0], [1.0, 0.75, 0.0], [3.0, 0.68, 0.0]])
    samples, tolerance = drawn.copy(), 0.1
    taut = choice.pulled(space, drawn)
    assert not polyline_free(space, thinned(taut, tolerance))
    choice.pull_legs(space, np.full(4, 3), np.ones(4, dtype=np.bool_), samples, tolerance)
    assert polyline_free(space, thinned(samples, tolerance))
