"""The command line: what it writes, prints and returns."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys

import pytest

from flockopt import Plan, Scene
from flockopt.batches.progress import StageLine
from flockopt.cli.text import printable, table


@pytest.fixture(scope="module")
def planned(root, tmp_path_factory):
    """A scene file and the plan file made of it, and what the command printed."""
    pytest.importorskip("matplotlib", reason="matplotlib comes with the extra 'show'")
    folder = tmp_path_factory.mktemp("planned")
    shutil.copy(root / "examples/scenes/two-drones.json", folder / "scene.json")
    command = [sys.executable, "-m", "flockopt", "plan", "scene.json", "-o", "plan.json", "--show", "plan.png"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return folder, done


def test_plan_writes_a_certified_plan_and_prints_the_table(planned):
    folder, done = planned
    assert done.returncode == 0, done.stderr
    scene = Scene.load(folder / "scene.json")
    plan = Plan.load(folder / "plan.json")
    assert plan.status == "certified"
    assert plan.scene_sha256 == scene.sha256
    assert (folder / "plan.png").read_bytes().startswith(b"\x89PNG")
    lines = done.stdout.splitlines()
    assert lines[0].split()[:4] == ["drone", "tasks", "metres", "seconds"]
    for drone in scene.drones:
        _, num_tasks, metres, seconds, *route = next(line for line in lines if line.startswith(drone.id)).split()
        assert route == list(plan.routes[drone.id])
        assert int(num_tasks) == len(route)
        assert float(metres) == pytest.approx(plan.flights[drone.id].curve.length, abs=0.006)
        assert float(seconds) == pytest.approx(plan.flights[drone.id].curve.end_time, abs=0.006)
    assert f"{plan.cost.travel:.2f} m" in done.stdout
    assert f"{plan.cost.lower_bound:.2f} m" in done.stdout
    assert f"{plan.cost.gap:.2%}" in done.stdout
    for clause in plan.certificate.clauses:
        assert any(line.split()[:2] == [clause.name, "holds"] for line in lines)


def test_verify_prints_a_row_for_each_clause(planned, flockopt):
    folder, _ = planned
    status, out, err = flockopt("verify", folder / "scene.json", folder / "plan.json")
    assert (status, err) == (0, "")
    names = {line.split()[0] for line in out.splitlines() if line}
    clauses = {"coverage", "capacity", "start", "visits", "continuity", "limits", "bounds", "clearance", "separation", "bound"}
    assert clauses <= names
    assert "FAILS" not in out


def test_verify_names_the_clause_that_fails(planned, flockopt, tmp_path):
    folder, _ = planned
    record = json.loads((folder / "plan.json").read_text())
    record["trajectories"][0]["coefficients"][0][2][0] += 0.05
    (tmp_path / "bent.json").write_text(json.dumps(record))
    status, out, _ = flockopt("verify", folder / "scene.json", tmp_path / "bent.json")
    assert status == 1
    assert next(line for line in out.splitlines() if line.startswith("start")).split()[1] == "FAILS"


def test_a_plan_for_another_scene_is_bad_input(planned, flockopt, tmp_path, two_drones):
    folder, _ = planned
    two_drones["clearance"] = 0.11
    (tmp_path / "other.json").write_text(json.dumps(two_drones))
    for command in (("verify",), ("show", "-o", tmp_path / "a.png")):
        status, out, err = flockopt(*command, tmp_path / "other.json", folder / "plan.json")
        assert (status, out) == (2, "")
        assert "sha256" in err
        assert err.count("\n") == 1
    assert not (tmp_path / "a.png").exists()


def test_the_same_seed_gives_the_same_plan(planned, flockopt, tmp_path):
    folder, _ = planned
    status, out, _ = flockopt("plan", folder / "scene.json", "-o", tmp_path / "again.json", "--seed", 0, "--quiet")
    assert (status, out) == (0, "")
    first, again = (json.loads(path.read_text()) for path in (folder / "plan.json", tmp_path / "again.json"))
    for record in (first, again):
        del record["timing"]
    assert first == again


def test_infeasible_scenes_say_why(flockopt, two_drones, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib comes with the extra 'show'")
    two_drones["drones"][0]["capacity"] = two_drones["drones"][1]["capacity"] = 1
    (tmp_path / "scene.json").write_text(json.dumps(two_drones))
    status, out, err = flockopt("plan", tmp_path / "scene.json", "-o", tmp_path / "plan.json", "--show", tmp_path / "plan.png")
    assert status == 1
    assert "Traceback" not in err
    plan = Plan.load(tmp_path / "plan.json")
    assert plan.status == "infeasible"
    assert plan.reason
    assert plan.reason in out
    assert "demand 3" in plan.reason
    assert "carries 2" in plan.reason


def test_a_walled_in_task_is_named(flockopt, two_drones, tmp_path):
    walls = [((8.1, 8, 2), (0.2, 2.4, 4)), ((9.9, 8, 2), (0.2, 2.4, 4)), ((9, 7, 2), (2, 0.2, 4)), ((9, 9, 2), (2, 0.2, 4))]
    two_drones["obstacles"] = [
        {"id": f"wall{k}", "shape": "box", "center": center, "size": size} for k, (center, size) in enumerate(walls)
    ]
    (tmp_path / "scene.json").write_text(json.dumps(two_drones))
    status, out, _ = flockopt("plan", tmp_path / "scene.json", "-o", tmp_path / "plan.json")
    assert status == 1
    plan = Plan.load(tmp_path / "plan.json")
    assert plan.status == "infeasible"
    assert "t2" in plan.unserved
    assert "t2" in out


def test_a_scene_with_no_tasks_is_fine(flockopt, two_drones, tmp_path):
    two_drones["tasks"] = []
    (tmp_path / "scene.json").write_text(json.dumps(two_drones))
    status, _, err = flockopt("plan", tmp_path / "scene.json", "-o", tmp_path / "plan.json")
    assert status == 0, err
    assert flockopt("verify", tmp_path / "scene.json", tmp_path / "plan.json")[0] == 0


def test_generate_gives_what_was_asked_for(flockopt, tmp_path):
    arguments = ("generate", "forest", "--drones", 3, "--tasks", 5, "--seed", 7)
    assert flockopt(*arguments, "-o", tmp_path / "a.json") == (0, "", "")
    assert flockopt(*arguments, "-o", tmp_path / "b.json") == (0, "", "")
    scene = Scene.load(tmp_path / "a.json")
    assert (scene.num_drones, scene.num_tasks) == (3, 5)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


@pytest.mark.parametrize("suffix", ["png", "html"])
def test_show_draws_a_scene_alone(flockopt, root, tmp_path, suffix):
    if suffix == "png":
        pytest.importorskip("matplotlib", reason="matplotlib comes with the extra 'show'")
    target = tmp_path / f"scene.{suffix}"
    assert flockopt("show", root / "examples/scenes/two-drones.json", "-o", target) == (0, "", "")
    assert target.stat().st_size > 1000


@pytest.mark.parametrize("command", [(), ("plan",), ("plan-many",), ("verify",), ("show",), ("generate",)])
def test_help_teaches_by_example(command):
    done = subprocess.run([sys.executable, "-m", "flockopt", *command, "--help"], capture_output=True, text=True)
    assert done.returncode == 0
    assert "exit status" in done.stdout
    if command:
        assert f"flockopt {command[0]} " in done.stdout.split("example")[1]


def test_version():
    done = subprocess.run([sys.executable, "-m", "flockopt", "--version"], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("flockopt 0.")


def test_a_reader_who_leaves_early_is_no_error(planned):
    folder, _ = planned
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-m", "flockopt", "verify", "scene.json", "plan.json"],
        cwd=folder, stdout=writing, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_interrupt_ends_without_a_traceback(flockopt, root, monkeypatch, tmp_path):
    def interrupted(path):
        raise KeyboardInterrupt

    monkeypatch.setattr(Scene, "load", interrupted)
    status, out, err = flockopt("plan", root / "examples/scenes/two-drones.json", "-o", tmp_path / "plan.json")
    assert (status, out) == (130, "")
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "words"), [(Terminal(), "\rsearch 50%, 2.0 s"), (io.StringIO(), "search, 2.0 s\n")])
def test_progress_speaks_after_a_second(monkeypatch, stream, words):
    now = [100.0]
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr("flockopt.batches.progress.time.monotonic", lambda: now[0])
    with StageLine() as progress:
        progress("travel", 0.5)
        assert stream.getvalue() == ""
        now[0] += 2.0
        progress("search", 0.5)
        progress("search", 0.6)
        assert stream.getvalue() == words
    if stream.isatty():
        assert stream.getvalue().endswith("\r" + " " * len(words.strip()) + "\r")


@pytest.mark.parametrize(
    ("stream", "words"),
    [
        (Terminal(), "\rcompiling 5, 2.0 s\rcompiling 20, 4.0 s\rcompiling 25, 6.0 s"),
        (io.StringIO(), "compiling 20, 4.0 s\n"),
    ],
)
def test_progress_speaks_now_and_then_in_the_middle_of_a_stage(monkeypatch, stream, words):
    now = [100.0]
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr("flockopt.batches.progress.time.monotonic", lambda: now[0])
    with StageLine() as progress:
        progress.tell("compiling 1", 0.01)
        for percent in (5, 20, 25):
            now[0] += 2.0
            progress.tell(f"compiling {percent}", 0.01 * percent)
        assert stream.getvalue() == words


def test_progress_can_be_quiet(monkeypatch, capsys):
    times = iter([0.0, 9.0])
    monkeypatch.setattr("flockopt.batches.progress.time.monotonic", lambda: next(times))
    with StageLine(quiet=True) as progress:
        progress("travel", 0.5)
    assert capsys.readouterr().err == ""


def test_tables_line_up_and_stay_on_their_lines():
    lines = table(("id", "m"), [("a\nb\x1b[31m", "1.0"), ("x" * 200, "10.25")], right=(1,)).splitlines()
    assert len(lines) == 4
    assert len({len(line) for line in lines}) == 1
    assert lines[2].startswith("a\\nb\\x1b[31m")
    assert printable("naïve 7 m") == "naïve 7 m"


def test_the_exact_planner_says_that_its_plan_is_the_best(flockopt, tmp_path, root):
    pytest.importorskip("highspy", reason="highspy comes with the extra 'solvers'")
    output = tmp_path / "plan.json"
    status, out, _ = flockopt("plan", root / "examples/scenes/rotterdam.json", "-o", output, "--planner", "exact")
    assert status == 0
    assert "gap       0.00%: no allocation travels less, and that is proven" in out
    status, out, _ = flockopt("verify", root / "examples/scenes/rotterdam.json", output)
    assert status == 0
    record = json.loads(output.read_text())
    assert record["cost"]["gap"] == 0.0
    assert record["settings"]["seed"] == 0
