"""Scenes far from zero: seen from their midst, exactly, and planned, judged and replanned in their own coordinates."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from flockopt import Bounds, Changes, Plan, Scene, Task, certify, plan, replan
from flockopt.scene.frame import Frame


def moved(scene: Scene, offset) -> Scene:
    def there(place):
        return tuple((np.array(place) + offset).tolist())

    return scene.replace(
        bounds=Bounds(there(scene.bounds.lower), there(scene.bounds.upper)),
        drones=tuple(dataclasses.replace(drone, start=there(drone.start)) for drone in scene.drones),
        tasks=tuple(dataclasses.replace(task, position=there(task.position)) for task in scene.tasks),
        obstacles=tuple(dataclasses.replace(record, center=there(record.center)) for record in scene.obstacles),
    )


OFFSETS = [(5e5, 4.6e6, 0.0), (1e7, -1e7, 1e7), (9.9e7, -9.9e7, 9.9e7), (3.25e4, 0.0, 0.0)]


def test_a_scene_near_zero_stays_as_it_is(scene):
    frame = Frame.of(scene.bounds)
    assert frame.is_own
    assert frame.near(scene) is scene


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_far_scene_is_seen_exactly(scene, offset):
    far = moved(scene, np.array(offset))
    frame = Frame.of(far.bounds)
    near = frame.near(far)
    assert np.abs(near.task_positions).max() < 20
    assert [frame.out_of(task.position) for task in near.tasks] == [task.position for task in far.tasks]
    assert near.origin is None


@pytest.mark.parametrize("offset", OFFSETS)
def test_far_scenes_are_planned_as_near_ones_and_told_in_their_own_coordinates(scene, offset, tmp_path):
    far = moved(scene, np.array(offset))
    made, here = plan(far, planner="classical"), plan(scene, planner="classical")
    assert made.status == "certified"
    assert made.scene_sha256 == far.sha256
    assert made.cost.travel == pytest.approx(here.cost.travel, abs=1e-6)
    made.save(tmp_path / "plan.json")
    for engine in ("closed-form", "fcl"):
        judged = certify(far, Plan.load(tmp_path / "plan.json"), engine=engine)
        assert judged.certified
        place, near = judged["clearance"].place, here.certificate["clearance"].place
        assert np.allclose(np.array(place) - offset, near, atol=0.05)
    for drone in far.drones:
        assert np.allclose(made.flights[drone.id].curve(0.0), drone.start, atol=1e-6)


@pytest.mark.parametrize("offset", OFFSETS[:2])
def test_far_fleets_are_replanned(scene, offset):
    far = moved(scene, np.array(offset))
    new = Task("new", tuple((np.array((6.0, 2.0, 1.5)) + offset).tolist()))
    answer = replan(far, plan(far, planner="classical"), 1.0, Changes(added=(new,)))
    assert "new" in [task.id for task in answer.scene.tasks]
    assert answer.plan.status == "certified"
    assert certify(answer.scene, answer.plan).certified
    assert answer.scene.bounds == far.bounds


def test_a_flight_that_is_off_by_a_millimetre_is_seen_far_from_zero_too(scene):
    far = moved(scene, np.array(OFFSETS[1]))
    made = plan(far, planner="classical")
    flight = made.flights["d0"]
    coefficients = np.array(flight.curve.coefficients)
    coefficients[-1, 0, 0] += 2e-3
    curve = dataclasses.replace(flight.curve, coefficients=coefficients)
    flights = made.flights | {"d0": dataclasses.replace(flight, curve=curve)}
    judged = certify(far, dataclasses.replace(made, flights=flights))
    assert "continuity" in [clause.name for clause in judged.failed]
