"""Missions for QGroundControl: its documented format, and places and speeds that are the plan's."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from flockopt import Bounds, Curve, Flight, Scene, SceneError, Visit, export, plan
from flockopt.outputs.devices.geodesy import local

#: A place in UTM coordinates, and nothing there.
FAR = Bounds((5e5 - 10, 4.6e6 - 10, 0), (5e5 + 10, 4.6e6 + 10, 5))
NOTHING = {"tasks": (), "obstacles": ()}

COMMANDS = {"waypoint": 16, "loiter": 17, "land": 21, "takeoff": 22, "speed": 178}


@pytest.fixture(scope="module")
def placed():
    """The example scene on Earth: one drone returns, one task takes time. And a plan for it."""
    from tests.conftest import TWO_DRONES

    drones = [TWO_DRONES["drones"][0] | {"end": "start"}, *TWO_DRONES["drones"][1:]]
    tasks = [TWO_DRONES["tasks"][0] | {"service_time": 2.5}, *TWO_DRONES["tasks"][1:]]
    origin = {"latitude": 51.999, "longitude": 4.3735, "altitude": 3.0, "heading": 0.4}
    scene = Scene.from_dict(TWO_DRONES | {"drones": drones, "tasks": tasks, "origin": origin, "clearance": 0.1})
    return scene, plan(scene, bound="fast")


@pytest.fixture
def missions(placed, tmp_path):
    scene, flown = placed
    outcome = export(flown, to="qgroundcontrol", path=tmp_path / "fleet", scene=scene)
    assert outcome.misfits == ()
    assert outcome.files[:-1] == tuple(f"{drone.id}.plan" for drone in scene.drones if drone.id in flown.flights)
    return {drone: json.loads((tmp_path / f"fleet/{drone}.plan").read_text()) for drone in flown.flights}


def is_number(value):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(value)


def check_format(record):
    """What QGroundControl's developer guide requires of a plan file."""
    assert (record["fileType"], record["version"], record["groundStation"]) == ("Plan", 1, "QGroundControl")
    assert record["geoFence"] == {"circles": [], "polygons": [], "version": 2}
    assert record["rallyPoints"] == {"points": [], "version": 2}
    mission = record["mission"]
    required = {"version", "firmwareType", "globalPlanAltitudeMode", "vehicleType", "cruiseSpeed", "hoverSpeed", "items"}
    assert set(mission) == required | {"plannedHomePosition"}
    assert mission["version"] == 2
    assert len(mission["plannedHomePosition"]) == 3
    assert mission["items"]
    for number, item in enumerate(mission["items"], start=1):
        assert item["type"] == "SimpleItem"
        assert item["autoContinue"] is True
        assert item["doJumpId"] == number
        assert item["command"] in COMMANDS.values()
        assert len(item["params"]) == 7
        assert all(value is None or is_number(value) for value in item["params"])
        if item["command"] == COMMANDS["speed"]:
            assert item["frame"] == 2
        else:
            assert item["frame"] == 3
            assert item["params"][6] == item["Altitude"]
            assert item["AltitudeMode"] == 1
            assert abs(item["params"][4]) <= 90
            assert abs(item["params"][5]) <= 180
        if item["command"] == COMMANDS["waypoint"]:  # 0 would leave it to the autopilot, which may take ten metres
            assert 0.1 <= item["params"][1] <= 1.0


def places(scene, record):
    """Every item's command, its place in the scene, and its first parameter."""
    home = record["mission"]["plannedHomePosition"]
    for item in record["mission"]["items"]:
        if item["command"] != COMMANDS["speed"]:
            latitude, longitude, height = item["params"][4:]
            yield item["command"], np.array(local(scene.origin, latitude, longitude, home[2] + height)), item["params"][0]


def test_the_files_have_the_documented_format(missions):
    for record in missions.values():
        check_format(record)


def test_missions_visit_what_the_plan_visits(placed, missions):
    scene, flown = placed
    tasks = {task.id: task for task in scene.tasks}
    for drone in scene.drones:
        flight = flown.flights[drone.id]
        stops = list(places(scene, missions[drone.id]))
        assert stops[0][0] == COMMANDS["takeoff"]
        np.testing.assert_allclose(stops[0][1], drone.start, atol=2e-3)
        upcoming = iter(stops)
        for visit in flight.visits:  # in this order
            task = tasks[visit.task]
            found = next(stop for stop in upcoming if np.linalg.norm(stop[1] - task.position) < 2e-3)
            assert found[0] == COMMANDS["waypoint"]
            assert found[2] == task.service_time
        command, place, _ = stops[-1]
        if drone.end_point is None:
            assert command == COMMANDS["loiter"]
            np.testing.assert_allclose(place, flight.curve(flight.curve.end_time), atol=2e-3)
        else:
            assert command == COMMANDS["land"]
            np.testing.assert_allclose(place, (*drone.end_point[:2], 0.0), atol=2e-3)


def test_way_points_keep_to_the_curve_and_speeds_to_the_time(placed, missions):
    scene, flown = placed
    for drone, flight in flown.flights.items():
        line = np.array([place for _, place, _ in places(scene, missions[drone])][:-1])
        for place in flight.curve(np.linspace(flight.curve.start_time, flight.curve.end_time, 400)):
            steps = np.diff(line, axis=0)
            lengths = np.maximum(np.sum(steps**2, axis=1), 1e-12)
            share = np.clip(np.sum((place - line[:-1]) * steps, axis=1) / lengths, 0, 1)
            away = np.linalg.norm(line[:-1] + share[:, None] * steps - place, axis=1).min()
            assert away <= scene.clearance / 2 + 5e-3
        assert flight_time(scene, missions[drone]) == pytest.approx(flight.curve.end_time, rel=0.03, abs=0.1)


def flight_time(scene, record):
    """Seconds a drone needs that flies the set speeds, and holds where it should."""
    time, speed, stops = 0.0, None, places(scene, record)
    here = None
    for item in record["mission"]["items"]:
        if item["command"] == COMMANDS["speed"]:
            speed = item["params"][1]
            continue
        command, there, hold = next(stops)
        if command in (COMMANDS["takeoff"], COMMANDS["waypoint"]):
            distance = 0.0 if here is None else np.linalg.norm(there - here)
            time += (distance / speed if distance > 1e-2 else 0.0) + hold
            here = there
    return time


def test_a_late_start_is_a_hold(placed, tmp_path):
    scene, flown = placed
    late = replace(flown, flights={"d0": flown.flights["d0"].shifted(4.25)})
    export(late, to="qgroundcontrol", path=tmp_path / "fleet", scene=scene)
    record = json.loads((tmp_path / "fleet/d0.plan").read_text())
    _, second, *_ = places(scene, record)
    assert second[0] == COMMANDS["waypoint"]
    assert second[2] == 4.25
    np.testing.assert_allclose(second[1], scene.drones[0].start, atol=2e-3)


def test_resting_on_the_way_is_a_hold(placed, tmp_path):
    """A drone that serves where it starts, and waits after that."""
    scene, flown = placed
    rest = np.zeros((2, 3, 1))
    rest[:, :, 0] = scene.drones[0].start
    flight = Flight(Curve(np.array([0.0, 2.5, 6.0]), rest), (Visit("t0", 0.0),))
    export(replace(flown, flights={"d0": flight}), to="qgroundcontrol", path=tmp_path / "fleet", scene=scene)
    record = json.loads((tmp_path / "fleet/d0.plan").read_text())
    check_format(record)
    assert [hold for command, _, hold in places(scene, record) if command == COMMANDS["waypoint"]] == [2.5, 3.5]
    assert all(item["command"] != COMMANDS["speed"] for item in record["mission"]["items"])


def test_the_same_plan_gives_the_same_bytes(placed, missions, tmp_path):
    scene, flown = placed
    before = {path.name: path.read_bytes() for path in (tmp_path / "fleet").iterdir()}
    export(flown, to="qgroundcontrol", path=tmp_path / "fleet", scene=scene)
    assert {path.name: path.read_bytes() for path in (tmp_path / "fleet").iterdir()} == before


def test_a_scene_that_is_nowhere_is_refused(scene, tmp_path):
    flown = plan(scene, bound="fast")
    with pytest.raises(SceneError) as caught:
        export(flown, to="qgroundcontrol", path=tmp_path / "fleet", scene=scene)
    assert caught.value.field == "origin"
    assert list(tmp_path.iterdir()) == []


def test_ids_that_make_no_file_name_do_not_fit(placed, tmp_path):
    scene, flown = placed
    drones = (replace(scene.drones[0], id="../d0"), *scene.drones[1:])
    renamed = scene.replace(drones=drones)
    flights = {"../d0": flown.flights["d0"]}
    outcome = export(
        replace(flown, scene_sha256=renamed.sha256, flights=flights), to="qgroundcontrol", path=tmp_path / "f", scene=renamed
    )
    assert "../d0" in outcome.misfits[0]
    assert list(tmp_path.iterdir()) == []


def test_the_command_line(placed, flockopt, tmp_path):
    scene, flown = placed
    scene.save(tmp_path / "scene.json")
    flown.save(tmp_path / "plan.json")
    arguments = ("export", tmp_path / "plan.json", "--to", "qgroundcontrol", "--scene", tmp_path / "scene.json")
    status, out, err = flockopt(*arguments, "-o", tmp_path / "fleet")
    assert (status, err) == (0, "")
    assert "d0.plan" in out
    nowhere = scene.replace(origin=None)
    nowhere.save(tmp_path / "scene.json")
    replace(flown, scene_sha256=nowhere.sha256).save(tmp_path / "plan.json")
    status, out, err = flockopt(*arguments, "-o", tmp_path / "other")
    assert (status, out) == (2, "")
    assert "scene.json: origin is missing" in err
    assert not (tmp_path / "other").exists()


def test_a_scene_far_from_its_origin_is_no_mission(placed, tmp_path):
    scene, made = placed
    far = scene.replace(
        drones=tuple(replace(drone, start=(5e5, 4.6e6, 1.0)) for drone in scene.drones[:1]), bounds=FAR, **NOTHING
    )
    outcome = export(replace(made, scene_sha256=far.sha256), to="qgroundcontrol", path=tmp_path / "out", scene=far)
    assert outcome.files == ()
    assert "drone d0 starts 4627 km from the scene's (0, 0, 0)" in outcome.misfits[0]
