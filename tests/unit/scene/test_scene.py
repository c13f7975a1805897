"""Scenes: the file format, validation on construction, edited copies."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math

import numpy as np
import pytest

from flockopt import Box, Cylinder, Drone, Scene, SceneError, Sphere, Task


def changed(record, path, value):
    """The JSON object with one value replaced; ``path`` is a sequence of keys and indices."""
    inner = record
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return record


@pytest.mark.parametrize("name", ["two-drones", "rotterdam", "delft"])
def test_example_scenes_survive_a_round_trip(root, tmp_path, name):
    scene = Scene.load(root / f"examples/scenes/{name}.json")
    scene.save(tmp_path / "again.json")
    again = Scene.load(tmp_path / "again.json")
    assert again == scene
    assert again.sha256 == scene.sha256


def test_every_optional_field_survives_a_round_trip(two_drones):
    two_drones["separation_z"] = 0.8
    two_drones["drones"][0] |= {"end": "start", "velocity": [1, 0, 0], "acceleration": [0, 1, 0], "max_distance": 30}
    two_drones["drones"][1]["end"] = [8, 2, 1]
    two_drones["tasks"][0] |= {"demand": 2, "service_time": 0.5}
    two_drones["obstacles"] += [
        {"id": "box", "shape": "box", "center": [8, 5, 1], "size": [1, 2, 2], "yaw": 0.3},
        {"id": "ball", "shape": "sphere", "center": [2, 3, 3], "radius": 0.5},
    ]
    scene = Scene.from_dict(two_drones)
    assert Scene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene
    assert [type(obstacle) for obstacle in scene.obstacles] == [Cylinder, Box, Sphere]
    assert scene.drones[0].end_point == (1, 1, 1)
    assert np.isnan(scene.ends).sum() == 0
    assert scene.widest_axes.tolist() == [0.4, 0.4, 0.8]


def test_the_digest_is_over_the_canonical_form(two_drones):
    scene = Scene.from_dict(two_drones)
    explicit = Scene.from_dict(changed(two_drones, ("tasks", 0, "demand"), 1))
    assert explicit.sha256 == scene.sha256
    canonical = json.dumps(scene.to_dict(), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert hashlib.sha256(canonical.encode()).hexdigest() == scene.sha256
    assert scene.to_dict()["drones"][0]["end"] is None
    assert Scene.from_dict(changed(two_drones, ("clearance",), 0.2)).sha256 != scene.sha256


def test_arrays_have_shapes_and_are_read_only(scene):
    assert scene.starts.shape == (2, 3)
    assert scene.task_positions.shape == (3, 3)
    assert scene.obstacle_table.shape == (1, 9)
    assert np.isnan(scene.ends).all()
    for array in (scene.starts, scene.capacities, scene.demands, scene.radii, scene.obstacle_table):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_records_cannot_be_changed(scene):
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.clearance = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.drones[0].capacity = 9


def test_replace_validates_anew(scene):
    assert scene.replace(clearance=0.2).clearance == 0.2
    assert scene.clearance == 0.1
    with pytest.raises(SceneError, match="clearance is -1"):
        scene.replace(clearance=-1)


def test_a_scene_may_be_empty_of_tasks_and_obstacles(scene):
    bare = scene.replace(tasks=(), obstacles=())
    assert bare.task_positions.shape == (0, 3)
    assert bare.obstacle_table.shape == (0, 9)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("format",), "flockopt.scene/2", "format is 'flockopt.scene/2'; must be \"flockopt.scene/1\""),
        (("name",), "", "name is ''"),
        (("colour",), "red", "colour is an unknown key"),
        (("clearance",), math.nan, "clearance is nan"),
        (("separation",), -0.1, "separation is -0.1"),
        (("separation_z",), 0, "separation_z is 0"),
        (("bounds", "upper"), [10, 0, 4], r"bounds.upper[1] is 0"),
        (("bounds", "upper"), [10, math.inf, 4], r"bounds.upper[1] is inf"),
        (("drones",), [], "drones is empty"),
        (("drones",), {}, "drones is {}; must be a list"),
        (("drones", 0), 7, "drones[0] is 7; must be an object"),
        (("drones", 1, "capacity"), -1, "drones[1].capacity is -1"),
        (("drones", 1, "capacity"), 1.5, "drones[1].capacity is 1.5"),
        (("drones", 1, "max_jerk"), 0, "drones[1].max_jerk is 0"),
        (("drones", 1, "max_distance"), 0, "drones[1].max_distance is 0"),
        (("drones", 1, "end"), "home", "drones[1].end is 'home'"),
        (("drones", 1, "end"), [5, 5, 2], "drones[1].end is"),
        (("drones", 1, "velocity"), [3, 0, 0], "drones[1].velocity has norm 3"),
        (("drones", 1, "acceleration"), [0, 5, 0], "drones[1].acceleration has norm 5"),
        (("drones", 1, "id"), "d0", "drones[1].id is 'd0', the same as drones[0].id"),
        (("drones", 1, "start"), [1, 1, 1], "drones[1].start is 0 m from drones[0].start"),
        (("drones", 1, "start"), [9, 11, 1], "drones[1].start[1] is 11; must be within bounds [0, 10]"),
        (("tasks", 2, "position"), [5, 5, 2], "tasks[2].position is -0.8 m from obstacle 'pillar'"),
        (("tasks", 2, "position"), [5, 5.99, 2], "tasks[2].position is 0.19 m from obstacle 'pillar'"),
        (("tasks", 2, "demand"), 0, "tasks[2].demand is 0"),
        (("tasks", 2, "service_time"), -1, "tasks[2].service_time is -1"),
        (("tasks", 2, "id"), "t0", "tasks[2].id is 't0'"),
        (("obstacles", 0, "shape"), "cone", "obstacles[0].shape is 'cone'; must be one of box, cylinder, sphere"),
        (("obstacles", 0, "shape"), ["box"], "obstacles[0].shape is ['box']"),
        (("obstacles", 0, "radius"), 0, "obstacles[0].radius is 0"),
        (("obstacles", 0, "size"), [1, 1, 1], "obstacles[0].size is an unknown key"),
    ],
)
def test_what_breaks_a_rule_is_named(two_drones, path, value, words):
    with pytest.raises(SceneError) as caught:
        Scene.from_dict(changed(two_drones, path, value))
    assert words in str(caught.value)
    assert caught.value.rule
    assert caught.value.mend
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "path", [("bounds",), ("drones",), ("tasks",), ("format",), ("drones", 0, "radius"), ("bounds", "lower")]
)
def test_a_missing_key_is_named(two_drones, path):
    inner = two_drones
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    with pytest.raises(SceneError, match=rf"{path[-1]} is missing"):
        Scene.from_dict(two_drones)


def test_a_flat_box_is_refused():
    with pytest.raises(SceneError, match=r"size\[1\] is 0"):
        Box("b", (0, 0, 0), (1, 0, 1))


def test_a_task_needs_the_room_of_the_smallest_drone_only(scene):
    close = Task("t9", (5.0, 6.05, 2.0))  # 0.25 m from the pillar
    big = dataclasses.replace(scene.drones[1], radius=0.3)
    assert scene.replace(drones=(scene.drones[0], big), tasks=(close,)).num_tasks == 1
    small = dataclasses.replace(scene.drones[0], radius=0.3)
    with pytest.raises(SceneError, match=r"tasks\[0\]\.position"):
        scene.replace(drones=(small, big), tasks=(close,))


def test_separation_z_makes_starts_an_ellipsoid_apart(scene):
    above = dataclasses.replace(scene.drones[1], start=(1.0, 1.0, 1.5))
    assert scene.replace(drones=(scene.drones[0], above)).num_drones == 2
    with pytest.raises(SceneError, match=r"drones\[1\]\.start"):
        scene.replace(drones=(scene.drones[0], above), separation_z=0.8)


def test_a_drone_can_be_made_from_arrays():
    drone = Drone("d", np.array([1.0, 2.0, 3.0]), np.int64(3), 0.1, 2.0, 4.0, 30.0)
    assert drone.start == (1.0, 2.0, 3.0)
    assert isinstance(drone.capacity, int)


def fleet(scene, *starts, radii=(0.15, 0.15), **fields):
    drones = tuple(
        dataclasses.replace(scene.drones[0], id=f"d{i}", start=start, radius=radius)
        for i, (start, radius) in enumerate(zip(starts, radii, strict=True))
    )
    return scene.replace(**{"drones": drones, "tasks": (), "obstacles": (), "separation": 0.0, "separation_z": None} | fields)


def test_bodies_count_where_the_separation_is_less(scene):
    pair = fleet(scene, (1, 1, 1), (2, 1, 1), radii=(0.1, 0.3))
    assert pair.axes_between(0, 1) == pytest.approx([0.4, 0.4, 0.4])
    assert pair.axes_between([0, 1], [0, 1]) == pytest.approx(np.array([[0.2] * 3, [0.6] * 3]))
    assert pair.replace(separation=0.5).axes_between(1, 0).tolist() == [0.5, 0.5, 0.5]
    assert pair.replace(separation=0.3, separation_z=0.9).axes_between(0, 1) == pytest.approx([0.4, 0.4, 0.9])
    assert pair.widest_axes == pytest.approx([0.4, 0.4, 0.4])


def test_bodies_that_overlap_at_the_start_are_refused_whatever_the_separation(scene):
    with pytest.raises(SceneError, match=r"drones\[1\]\.start is 0\.25 m from .*both radii: 0\.3 m"):
        fleet(scene, (1, 1, 1), (1.25, 1, 1))
    fleet(scene, (1, 1, 1), (1.3, 1, 1))


def test_an_ellipsoid_that_lets_bodies_overlap_is_refused(scene):
    with pytest.raises(
        SceneError, match=r"separation_z is 0\.2; must be >= the radii of the two largest drones together = 0\.3"
    ):
        fleet(scene, (1, 1, 1), (3, 1, 1), separation=0.5, separation_z=0.2)
