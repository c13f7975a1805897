"""Bad input to the command line: exit status 2, one line with field, value, rule and mend, and no file touched."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

OLD = "what stood here before"


def write(path, record):
    path.write_text(record if isinstance(record, str) else json.dumps(record), encoding="utf-8")
    return path


def snapshot(folder):
    return {path.name: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


def check_refused(outcome, *words):
    status, out, err = outcome
    assert status == 2
    assert out == ""
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert "Traceback" not in err
    for word in words:
        assert word in err
    assert err.count(";") >= 2, "field and value; rule; mend"


def broken(record, change):
    change(record)
    return record


def set_at(*path):
    *keys, last, value = path

    def change(record):
        for key in keys:
            record = record[key]
        record[last] = value

    return change


SCENES = {
    "not-json": ("{'drones': 3", ("is not JSON",)),
    "empty-file": ("", ("is not JSON",)),
    "not-an-object": ("[1, 2]", ("must be an object",)),
    "null": ("null", ("must be an object",)),
    "wrong-format-number": (set_at("format", "flockopt.scene/2"), ("format", "flockopt.scene/2", "flockopt.scene/1")),
    "unknown-key": (set_at("drones", 0, "colour", "red"), ("drones[0].colour", "unknown key")),
    "missing-key": (lambda record: record["drones"][1].pop("radius"), ("drones[1].radius", "missing")),
    "nan": (set_at("tasks", 1, "position", 2, float("nan")), ("tasks[1].position[2]", "nan")),
    "infinity": (set_at("clearance", float("inf")), ("clearance", "inf")),
    "text-for-a-number": (set_at("separation", "0.4"), ("separation", "'0.4'")),
    "negative-capacity": (set_at("drones", 1, "capacity", -1), ("drones[1].capacity is -1", "integers >= 0", "ground")),
    "duplicate-id": (set_at("tasks", 2, "id", "t0"), ("tasks[2].id", "'t0'", "tasks[0].id")),
    "task-in-an-obstacle": (set_at("tasks", 1, "position", [5, 5, 2]), ("tasks[1].position", "'pillar'")),
    "start-in-an-obstacle": (set_at("drones", 1, "start", [5, 5, 2]), ("drones[1].start", "'pillar'")),
    "two-starts-on-one-spot": (set_at("drones", 1, "start", [1, 1, 1]), ("drones[1].start", "drones[0].start")),
    "start-out-of-bounds": (set_at("drones", 0, "start", [1, 1, 9]), ("drones[0].start[2] is 9", "[0, 4]")),
    "zero-size-obstacle": (set_at("obstacles", 0, "radius", 0), ("obstacles[0].radius is 0",)),
    "flat-box": (
        set_at("obstacles", 0, {"id": "b", "shape": "box", "center": [5, 5, 2], "size": [1, 0, 1]}),
        ("obstacles[0].size[1] is 0",),
    ),
    "empty-fleet": (set_at("drones", []), ("drones is empty", "add a drone")),
    "line-break-in-an-id": (set_at("drones", 0, "id\n", "x"), ("unknown key",)),
    "half-a-character": (set_at("tasks", 0, "id", "\ud800"), ("tasks[0].id", "surrogate")),
}


@pytest.mark.parametrize("case", SCENES)
@pytest.mark.parametrize("command", ["plan", "show"])
def test_bad_scenes(flockopt, two_drones, tmp_path, command, case):
    change, words = SCENES[case]
    scene = write(tmp_path / "scene.json", broken(two_drones, change) if callable(change) else change)
    suffix = "json" if command == "plan" else "png"
    for name in (f"new.{suffix}", f"old.{suffix}"):
        if name.startswith("old"):
            write(tmp_path / name, OLD)
        before = snapshot(tmp_path)
        check_refused(flockopt(command, scene, "-o", tmp_path / name), str(scene), *words)
        assert snapshot(tmp_path) == before


def test_bad_scenes_for_verify(flockopt, two_drones, tmp_path):
    scene = write(tmp_path / "scene.json", broken(two_drones, set_at("drones", 1, "capacity", -1)))
    check_refused(flockopt("verify", scene, tmp_path / "plan.json"), "drones[1].capacity is -1")


@pytest.fixture
def good_scene(two_drones, tmp_path):
    return write(tmp_path / "scene.json", two_drones)


def unwritable_outputs(folder, suffix):
    (folder / f"folder{suffix}").mkdir()
    os.mkfifo(folder / f"pipe{suffix}")
    return {
        folder / f"folder{suffix}": "is a directory",
        folder / f"pipe{suffix}": "not a regular file",
        folder / "missing" / f"out{suffix}": "No such file or directory",
        folder / "scene.json" / f"out{suffix}": "Not a directory",
        folder / ("long" * 100 + suffix): "too long",
    }


def test_outputs_that_cannot_be_written(flockopt, good_scene, tmp_path):
    commands = {
        ("plan", good_scene, "-o"): ".json",
        ("show", good_scene, "-o"): ".png",
        ("generate", "forest", "-o"): ".scene",
        ("plan", good_scene, "-o", tmp_path / "plan.json", "--show"): ".html",
    }
    for command, suffix in commands.items():
        outputs = unwritable_outputs(tmp_path, suffix)
        before = snapshot(tmp_path)
        for path, words in outputs.items():
            check_refused(flockopt(*command, path), words, str(path), "choose another path")
        assert snapshot(tmp_path) == before


def test_an_output_may_not_be_an_input_or_another_output(flockopt, good_scene, tmp_path):
    before = snapshot(tmp_path)
    check_refused(flockopt("plan", good_scene, "-o", good_scene), "--output", "scene.json")
    check_refused(flockopt("plan", good_scene, "-o", f"{tmp_path}/./a.png", "--show", tmp_path / "a.png"), "--show")
    (tmp_path / "link.png").symlink_to(good_scene)
    check_refused(flockopt("show", good_scene, "-o", tmp_path / "link.png"), "--output")
    (tmp_path / "link.png").unlink()
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("name", ["missing.json", "folder", "scene.json/inside", "latin.json"])
def test_inputs_that_cannot_be_read(flockopt, good_scene, tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "latin.json").write_bytes(b'{"name": "caf\xe9"}')
    before = snapshot(tmp_path)
    check_refused(flockopt("plan", tmp_path / name, "-o", tmp_path / "out.json"), str(tmp_path / name))
    check_refused(flockopt("verify", good_scene, tmp_path / name), str(tmp_path / name))
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seed", "-1"], ("--seed", "'-1'", "integer >= 0")),
        (["--seed", "1.5"], ("--seed", "'1.5'")),
        (["--time-limit", "0"], ("--time-limit", "'0'", "> 0")),
        (["--time-limit", "nan"], ("--time-limit", "'nan'")),
        (["--time-limit", "inf"], ("--time-limit", "'inf'")),
        (["--time-limit", "soon"], ("--time-limit", "'soon'")),
        (["--planner", "nonsense"], ("planner", "'nonsense'", "classical")),
        (["--bound", "loose"], ("--bound", "'loose'", "tight")),
        (["--show", "picture.bmp"], ("--show", "picture.bmp", ".png")),
    ],
)
def test_bad_options(flockopt, good_scene, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    before = snapshot(tmp_path)
    check_refused(flockopt("plan", good_scene, "-o", "out.json", *arguments), *words)
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ("COMMAND", "--help")),
        (["fly"], ("fly", "plan", "--help")),
        (["plan"], ("SCENE", "--output", "--help")),
        (["plan", "a.json"], ("--output", "--help")),
        (["plan", "a.json", "-o"], ("--output", "--help")),
        (["plan", "a.json", "-o", "b.json", "--fast"], ("--fast", "--help")),
        (["generate", "desert", "-o", "never.json"], ("family", "'desert'", "forest")),
        (["generate", "forest", "--drones", "0", "-o", "never.json"], ("--drones", "'0'", "integer >= 1")),
        (["generate", "forest", "--tasks", "-3", "-o", "never.json"], ("--tasks", "'-3'", "integer >= 0")),
    ],
)
def test_bad_command_lines(flockopt, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    status, out, err = flockopt(*arguments)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    for word in words:
        assert word in err
    assert not list(tmp_path.iterdir())


def test_a_new_process_says_the_same(two_drones, tmp_path):
    scene = write(tmp_path / "scene.json", broken(two_drones, set_at("drones", 1, "capacity", -1)))
    command = [sys.executable, "-m", "flockopt", "plan", str(scene), "-o", str(tmp_path / "out.json")]
    done = subprocess.run(command, capture_output=True, text=True)
    check_refused((done.returncode, done.stdout, done.stderr), "drones[1].capacity is -1")
    assert not (tmp_path / "out.json").exists()


def test_a_plan_too_large_to_draw(flockopt, root, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib comes with the extra 'show'")
    scene = root / "examples/scenes/two-drones.json"
    assert flockopt("plan", scene, "-o", tmp_path / "plan.json", "--quiet") == (0, "", "")
    record = json.loads((tmp_path / "plan.json").read_text())
    record["trajectories"][0]["coefficients"][1][0][4] = 1e308
    plan = write(tmp_path / "plan.json", record)
    for suffix in ("html", "png"):
        check_refused(flockopt("show", scene, plan, "-o", tmp_path / f"a.{suffix}"), "trajectories[0].coefficients")
    assert [path.name for path in tmp_path.iterdir()] == ["plan.json"]
