"""Exports for Crazyswarm2: what the files hold, and what does not fit."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("yaml", reason="PyYAML comes with the extra 'trajectory'")
import yaml

from flockopt import Curve, Flight, MissingExtra, PlanError, export, plan
from flockopt.outputs.devices.crazyswarm2 import (
    HEADER,
    MOST_PIECES,
    fly_as_firmware,
    read_trajectory,
    trajectory_csv,
    trajectory_rows,
)


@pytest.fixture(scope="module")
def flown(scene):
    return plan(scene, bound="fast")


def loadcsv(path):
    """As in Crazyswarm2's own reader."""
    return np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(33), ndmin=2)


def evaluate(data, time):
    """x, y, z and yaw at a time, as Crazyswarm2's Trajectory.eval does it."""
    for row in data:
        if time <= row[0]:
            return [np.polynomial.polynomial.polyval(time, row[1 + 8 * axis : 9 + 8 * axis]) for axis in range(4)]
        time -= row[0]
    raise AssertionError("after the end")


def zigzag(pieces, start_time=0.0, corner=(0.0, 0.0, 1.0), span=1.0):
    """From rest to rest along x, a piece each second."""
    terms = np.zeros((pieces, 3, 6))
    for k in range(pieces):
        terms[k, :, 0] = corner
        terms[k, 0, 0] += k % 2
        terms[k, 0, 3:] = (1 - 2 * (k % 2)) * np.array([10.0, -15.0, 6.0]) / span ** np.arange(3, 6)
    return Curve(start_time + span * np.arange(pieces + 1), terms)


def with_curve(flown, curve, drone="d0"):
    return replace(flown, flights={drone: Flight(curve)}, routes={})


def test_the_files_fly_the_plan(flown, tmp_path):
    outcome = export(flown, to="crazyswarm2", path=tmp_path / "fleet")
    assert outcome.misfits == ()
    assert set(outcome.files) == {entry.name for entry in (tmp_path / "fleet").iterdir()}
    for drone, flight in flown.flights.items():
        path = tmp_path / "fleet" / f"{drone}.csv"
        assert path.read_text().splitlines()[0] == ",".join(HEADER)
        assert len(HEADER) == 33
        data = loadcsv(path)
        assert data[:, 0].sum() == pytest.approx(flight.curve.end_time)
        for time in np.linspace(0.0, data[:, 0].sum() - 1e-9, 500):
            x, y, z, yaw = evaluate(data, time)
            np.testing.assert_allclose([x, y, z], flight.curve(time), atol=1e-3)
            assert yaw == 0.0


def test_the_fleet_file_lists_everyone(flown, scene, tmp_path):
    export(flown, to="crazyswarm2", path=tmp_path / "fleet", scene=scene)
    fleet = yaml.safe_load((tmp_path / "fleet/crazyflies.yaml").read_text())
    assert {"robots", "robot_types", "all"} <= set(fleet)
    assert list(fleet["robots"]) == [drone.id for drone in scene.drones]
    assert len({robot["uri"] for robot in fleet["robots"].values()}) == scene.num_drones
    for drone in scene.drones:
        robot = fleet["robots"][drone.id]
        assert robot["enabled"] is True
        assert robot["type"] in fleet["robot_types"]
        assert all(isinstance(value, float) for value in robot["initial_position"])  # ROS refuses lists of both kinds
        np.testing.assert_allclose(robot["initial_position"], drone.start, atol=1e-9)


def test_drones_that_stay_are_switched_off_where_their_place_is_unknown(flown, scene, tmp_path):
    stays = replace(flown, flights={"d0": flown.flights["d0"]}, routes=dict(flown.routes) | {"d1": ()})
    export(stays, to="crazyswarm2", path=tmp_path / "a")
    robots = yaml.safe_load((tmp_path / "a/crazyflies.yaml").read_text())["robots"]
    assert robots["d1"]["enabled"] is False
    assert "initial_position" not in robots["d1"]
    export(stays, to="crazyswarm2", path=tmp_path / "b", scene=scene)
    robots = yaml.safe_load((tmp_path / "b/crazyflies.yaml").read_text())["robots"]
    assert robots["d1"]["initial_position"] == list(scene.drones[1].start)
    assert not (tmp_path / "b/d1.csv").exists()
    unnamed = replace(stays, routes={})
    export(unnamed, to="crazyswarm2", path=tmp_path / "c")
    assert list(yaml.safe_load((tmp_path / "c/crazyflies.yaml").read_text())["robots"]) == ["d0"]


def test_the_same_plan_gives_the_same_bytes(flown, tmp_path):
    for name in ("a", "b", "a"):
        export(flown, to="crazyswarm2", path=tmp_path / name)
    a, b = ({path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("a", "b"))
    assert a == b


def test_a_late_start_waits_in_a_piece(flown, tmp_path):
    curve = zigzag(2, start_time=1.75)
    assert export(with_curve(flown, curve), to="crazyswarm2", path=tmp_path / "fleet").misfits == ()
    data = loadcsv(tmp_path / "fleet/d0.csv")
    assert data.shape == (3, 33)
    assert data[0, 0] == 1.75
    for time in (0.0, 1.0, 1.75, 2.25, 3.7):
        np.testing.assert_allclose(evaluate(data, time)[:3], curve(time), atol=1e-12)


@pytest.mark.parametrize(
    ("pieces", "start_time", "fits"), [(31, 0.0, True), (32, 0.0, False), (30, 0.5, True), (31, 0.5, False)]
)
def test_at_most_31_pieces_fit_the_memory(flown, tmp_path, pieces, start_time, fits):
    assert MOST_PIECES == 31
    outcome = export(with_curve(flown, zigzag(pieces, start_time)), to="crazyswarm2", path=tmp_path / "fleet")
    assert bool(outcome.misfits) is not fits
    assert (tmp_path / "fleet").exists() is fits
    if not fits:
        assert "drone d0 has 32 pieces" in outcome.misfits[0]
        assert "31" in outcome.misfits[0]


def test_single_precision_far_from_the_origin_does_not_fit(flown, tmp_path):
    outcome = export(with_curve(flown, zigzag(4, corner=(90_000.0, 0.0, 1.0))), to="crazyswarm2", path=tmp_path / "fleet")
    assert "single precision" in outcome.misfits[0]
    assert not (tmp_path / "fleet").exists()


@pytest.mark.parametrize("name", ["1st", "a/b", "../x", "a b", "naïve", "a.b", "a\n"])
def test_ids_that_ros_does_not_take(flown, tmp_path, name):
    outcome = export(with_curve(flown, zigzag(2), drone=name), to="crazyswarm2", path=tmp_path / "fleet")
    assert name in outcome.misfits[0]
    assert list(tmp_path.iterdir()) == []


def test_every_misfit_is_told(flown, tmp_path):
    many = replace(flown, flights={"d0": Flight(zigzag(40)), "d 1": Flight(zigzag(2)), "d2": Flight(zigzag(2))}, routes={})
    assert len(export(many, to="crazyswarm2", path=tmp_path / "fleet").misfits) == 2


def test_nothing_to_fly(flown, tmp_path):
    empty = replace(flown, status="infeasible", flights={}, reason="the capacity is short by 2")
    outcome = export(empty, to="crazyswarm2", path=tmp_path / "fleet")
    assert "short by 2" in outcome.misfits[0]
    assert not (tmp_path / "fleet").exists()


@pytest.mark.parametrize("seed", range(5))
def test_what_is_written_reads_back_exactly(seed):
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.4], 0.4 + np.cumsum(rng.uniform(0.1, 3.0, 6))])
    rows = trajectory_rows(Curve(times, rng.normal(size=(6, 3, 8)) * 10.0 ** rng.integers(-9, 3, (6, 3, 8))))
    np.testing.assert_array_equal(read_trajectory(trajectory_csv(rows)), rows)


def test_the_reader_notices_a_changed_number():
    rows = trajectory_rows(zigzag(3))
    rows[1, 4] += 0.01
    times = np.linspace(0.0, 3.0, 301)
    away = np.linalg.norm(fly_as_firmware(rows, times) - zigzag(3)(times), axis=1)
    assert 5e-3 < away.max() < 1e-2 + 1e-5
    assert away[times <= 1.0].max() < 1e-6


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,2\n", ",".join(HEADER), ",".join(HEADER) + "\n1,2\n", ",".join(HEADER) + "\n" + ",".join(["x"] * 33)]
)
def test_the_reader_is_strict(text):
    with pytest.raises(PlanError):
        read_trajectory(text)


def test_without_pyyaml_it_names_the_extra(flown, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingExtra, match="trajectory"):
        export(flown, to="crazyswarm2", path=tmp_path / "fleet")
    assert not (tmp_path / "fleet").exists()


def test_the_command_line(flown, scene, flockopt, tmp_path):
    flown.save(tmp_path / "plan.json")
    status, out, err = flockopt("export", tmp_path / "plan.json", "--to", "crazyswarm2", "-o", tmp_path / "fleet")
    assert (status, err) == (0, "")
    assert "crazyflies.yaml" in out
    assert "warning" not in out
    with_curve(flown, zigzag(40)).save(tmp_path / "long.json")
    status, out, err = flockopt("export", tmp_path / "long.json", "--to", "crazyswarm2", "-o", tmp_path / "long")
    assert (status, err) == (1, "")
    assert "drone d0 has 40 pieces" in out
    assert not (tmp_path / "long").exists()
    replace(flown, status="uncertified").save(tmp_path / "doubtful.json")
    status, out, _ = flockopt("export", tmp_path / "doubtful.json", "--to", "crazyswarm2", "-o", tmp_path / "doubtful")
    assert status == 0
    assert "warning: the plan is uncertified" in out


def test_bad_input_to_the_command_line(flown, flockopt, tmp_path, two_drones):
    import json

    plan_file = tmp_path / "plan.json"
    flown.save(plan_file)
    (tmp_path / "other.json").write_text(json.dumps(two_drones | {"clearance": 0.11}))
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat.png").write_text("cat")
    for arguments, words in (
        ((plan_file, "--to", "paper", "-o", tmp_path / "out"), "--to is 'paper'"),
        ((tmp_path / "none.json", "--to", "crazyswarm2", "-o", tmp_path / "out"), "none.json"),
        ((plan_file, "--to", "crazyswarm2", "-o", tmp_path / "photos"), "photos holds other files"),
        ((plan_file, "--to", "crazyswarm2", "-o", plan_file), "not a directory"),
        ((plan_file, "--to", "crazyswarm2", "-o", tmp_path / "out", "--scene", tmp_path / "other.json"), "scene.sha256"),
        ((plan_file, "--to", "qgroundcontrol", "-o", tmp_path / "out"), "--scene is missing"),
    ):
        status, out, err = flockopt("export", *arguments)
        assert (status, out) == (2, ""), words
        assert words in err
        assert err.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"plan.json", "other.json", "photos"}
