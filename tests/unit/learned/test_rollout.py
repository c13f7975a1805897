"""The offline execution planner: samples that pass exactly through anchors, along the legs."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import Bundles, SettingsError, compute_travel, generate, refine_bundles
from flockopt.flights.waypoints import leg_clear
from flockopt.scene import Cylinder
from learned.paths.rollout import anchor_places, roll_out
from tests.flights import drone, make_scene


def test_places_are_in_proportion_to_straight_distance():
    anchors = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 0, 0]])
    np.testing.assert_array_equal(anchor_places(anchors, 9), [0, 2, 6, 8])


@pytest.mark.parametrize("num_samples", [4, 5, 64])
def test_places_rise_strictly_whatever_the_distances(num_samples):
    rng = np.random.default_rng(0)
    for _ in range(50):
        anchors = rng.uniform(0, 1, (4, 3)) * rng.choice([0.0, 1e-9, 1.0], (4, 1))
        places = anchor_places(anchors, num_samples)
        assert places[0] == 0
        assert places[-1] == num_samples - 1
        assert (np.diff(places) > 0).all()


def test_more_anchors_than_samples_are_refused():
    with pytest.raises(SettingsError, match="num_samples is 3; must be at least 4"):
        anchor_places(np.zeros((4, 3)), 3)


def test_samples_are_uniform_along_a_straight_leg_and_idle_drones_stay():
    scene = make_scene([drone(0, (1, 1, 1)), drone(1, (9, 9, 1))], [(5, 1, 1)])
    rollout = roll_out(scene, Bundles(((0,), ())), compute_travel(scene).path, num_samples=5)
    np.testing.assert_allclose(rollout.samples[0, :, 0], [1, 2, 3, 4, 5], atol=1e-12)
    np.testing.assert_array_equal(rollout.samples[1], np.tile([9.0, 9, 1], (5, 1)))
    assert [list(places) for places in rollout.places] == [[4], []]
    assert rollout.length == pytest.approx(4.0)


def test_an_end_is_the_last_sample():
    scene = make_scene([drone(0, (1, 1, 1), end=(1, 1, 2))], [(5, 1, 1)])
    rollout = roll_out(scene, Bundles(((0,),)), compute_travel(scene).path)
    np.testing.assert_array_equal(rollout.samples[0, -1], [1, 1, 2])
    np.testing.assert_array_equal(rollout.samples[0, rollout.places[0][0]], [5, 1, 1])


def test_a_bend_is_a_sample_so_that_chords_cut_no_corner():
    tree = Cylinder("tree", (3, 1, 2), 0.8, 4)
    scene = make_scene([drone(0, (1, 1, 1))], [(5, 1.1, 1)], (tree,))
    travel = compute_travel(scene)
    rollout = roll_out(scene, Bundles(((0,),)), travel.path, num_samples=7)
    path = travel.path(0, -1, 0)
    assert len(path) > 2
    for bend in path:
        assert np.abs(rollout.samples[0] - bend).max(axis=1).min() == 0.0
    assert leg_clear(scene, 0, rollout.samples[0])


@pytest.mark.parametrize("family", ["forest", "corridor", "rooms", "warehouse", "city"])
def test_samples_pass_through_tasks_and_are_clear(family):
    scene = generate(family, drones=3, tasks=9, seed=1)
    travel = compute_travel(scene)
    bundles = refine_bundles(scene, travel=travel, iterations=100)
    rollout = roll_out(scene, bundles, travel.path)
    assert rollout.length == pytest.approx(travel.total(bundles.routes))
    for index, route in enumerate(bundles):
        np.testing.assert_array_equal(rollout.samples[index, rollout.places[index]], scene.task_positions[list(route)])
        assert [int(task) for task in rollout.stops[index] if task >= 0] == list(route)
        assert leg_clear(scene, index, rollout.samples[index])


def test_a_leg_without_a_way_is_named():
    scene = make_scene([drone(0, (1, 1, 1))], [(5, 1, 1)])
    with pytest.raises(SettingsError, match=r"bundles\[0\] is \(0,\); every leg must have a way for drone 'd0'"):
        roll_out(scene, Bundles(((0,),)), lambda *leg: np.empty((0, 3)))
