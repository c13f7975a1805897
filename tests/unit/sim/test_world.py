"""The PyBullet world: asked only where something could touch, and never missing that it does."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet comes with the extra 'sim'")

from flockopt import Cylinder, SettingsError, Sphere, plan
from sim.mission.execute import execute
from sim.physics import world
from sim.physics.fleet import STATE_WIDTH
from sim.physics.proximity import within_reach
from sim.physics.settings import FlightSettings
from sim.physics.vehicles import vehicles_of
from tests.flights import drone, make_scene

STEP_S = 1 / 240
PILLAR = Cylinder("pillar", (5, 5, 2), 0.6, 4.0)


class Pushed:
    """A world whose drones fly straight on at given velocities, with no controller."""

    def __init__(self, scene, velocities, **options):
        self.place = world.World(scene, vehicles_of(scene), STEP_S, **options)
        self.states = np.zeros((scene.num_drones, STATE_WIDTH))
        self.states[:, :3], self.states[:, 6], self.states[:, 7:10] = scene.starts, 1.0, velocities
        self.touches, self.now_s = [], 0.0

    def fly(self, seconds):
        for _ in range(round(seconds / STEP_S)):
            drive = self.states[:, 7:10].copy()
            self.states[:, :3] += STEP_S * drive
            self.now_s += STEP_S
            self.touches += self.place.step(self.states, drive, np.zeros_like(drive), self.now_s)
        return self

    def poses(self):
        """(N, 3) m, where PyBullet has the bodies."""
        place = self.place
        place._catch_up()
        return np.array([place._bullet.getBasePositionAndOrientation(body, place.client)[0] for body in place.bodies])


def crossing():
    """Two drones that meet beside a pillar, one of which is thrown against it, and one that passes far away."""
    drones = [drone(0, (3, 5.9, 1)), drone(1, (7, 5.85, 1.05)), drone(2, (1, 1, 1))]
    return make_scene(drones, [], (PILLAR, Sphere("rock", (8, 8, 1), 0.3))), [(2, 0, 0), (-2, 0, 0), (1, 0, 0)]


def test_contacts_are_the_same_whether_pybullet_moves_in_every_step_or_only_near_something():
    runs = [Pushed(*crossing(), every_step=every_step).fly(3.0) for every_step in (False, True)]
    assert {(touch.drone, touch.other) for touch in runs[0].touches} >= {("d0", "d1")}
    assert runs[0].touches == runs[1].touches
    np.testing.assert_allclose(runs[0].states, runs[1].states, atol=1e-6)
    np.testing.assert_allclose(runs[0].poses(), runs[0].states[:, :3], atol=1e-9)


def test_bodies_are_where_the_drones_are_without_being_read():
    run = Pushed(*crossing(), every_step=True).fly(0.5)
    np.testing.assert_allclose(run.poses(), run.states[:, :3], atol=1e-9)


@pytest.mark.parametrize("shape", world.SHAPES)
def test_flights_are_the_same_either_way(shape):
    scene = make_scene([drone(0, (1, 5, 1)), drone(1, (9, 5.4, 1.2))], [(9, 4.5, 1), (1, 5.6, 1.4)], (PILLAR,))
    made = plan(scene, bound="fast")
    lazy = execute(scene, made, FlightSettings(shape=shape))
    whole = execute(scene, made, FlightSettings(shape=shape, every_step=True))
    np.testing.assert_allclose(whole.states, lazy.states, atol=1e-9)


@pytest.mark.parametrize(("gap", "is_asked", "touches"), [(0.1, False, 0), (0.03, True, 0), (-0.01, True, 1)])
def test_pybullet_is_asked_when_something_is_near(monkeypatch, gap, is_asked, touches):
    scene = make_scene([drone(0, (2, 5.6 + 0.12 + gap, 1))], [], (PILLAR,))
    run = Pushed(scene, [(2, 0, 0)])
    asked = []
    monkeypatch.setattr(run.place, "_moved", lambda *args, moved=run.place._moved: asked.append(1) or moved(*args))
    run.fly(2.0)
    assert (bool(asked), len(run.touches)) == (is_asked, touches)
    assert len(asked) < 300


def test_fast_drones_are_seen_in_time():
    scene = make_scene([drone(0, (1.03, 5, 1))], [], (PILLAR,))
    assert [touch.other for touch in Pushed(scene, [(24, 0, 0)]).fly(0.3).touches] == ["pillar"]


def test_a_drone_that_is_removed_touches_nothing():
    scene, velocities = crossing()
    run = Pushed(scene, velocities).fly(0.1)
    run.place.remove(0)
    run.states = np.delete(run.states, 0, axis=0)
    run.fly(3.0)
    assert run.touches == []
    assert len(run.poses()) == 2
    np.testing.assert_allclose(run.poses(), run.states[:, :3], atol=1e-9)


def test_reach_is_what_distances_say():
    rng = np.random.default_rng(0)
    answers = []
    for _ in range(300):
        places = rng.uniform((3.5, 3.5, 0.5), (6.5, 6.5, 3.5), (2, 3))
        states, drive = np.zeros((2, STATE_WIDTH)), rng.normal(size=(2, 3))
        states[:, :3] = places
        scene = make_scene([drone(0, (1, 1, 1))], [], (PILLAR,))
        speeds = np.linalg.norm(drive, axis=1)
        gaps = np.hypot(places[:, 0] - 5, places[:, 1] - 5) - 0.6 - 0.12 - STEP_S * speeds
        apart = np.linalg.norm(places[0] - places[1]) - 0.24 - STEP_S * speeds.sum()
        found = within_reach(scene.obstacle_table, scene.obstacle_boxes, np.full(2, 0.12), states, drive, STEP_S, 0.05)
        answers.append(found)
        assert found == (min(*gaps, apart) < 0.05)
    assert 10 < sum(answers) < 290


def test_bad_settings_are_named():
    scene = make_scene([drone(0, (1, 1, 1))], [])
    with pytest.raises(SettingsError, match=r"^shape is 'cube'"):
        world.World(scene, vehicles_of(scene), STEP_S, shape="cube")
    with pytest.raises(SettingsError, match=r"^step_s is 0"):
        world.World(scene, vehicles_of(scene), 0.0)
