"""The command line where the machine does not play along: closed and full streams, no place to write, files through pipes."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from flockopt import Plan, Scene, plan

FLOCKOPT = [sys.executable, "-m", "flockopt"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small scene and its plan, in files."""
    folder = tmp_path_factory.mktemp("surroundings")
    scene = Scene.load("examples/scenes/two-drones.json")
    scene.save(folder / "scene.json")
    plan(scene, planner="classical").save(folder / "plan.json")
    return folder


def run(*arguments, shell="", stdin="", **environment):
    """A command's status, stdout and stderr; with ``shell`` behind it, such as a redirection."""
    command = " ".join([*FLOCKOPT, *map(str, arguments), shell])
    done = subprocess.run(
        ["bash", "-c", command], input=stdin, env=os.environ | environment, capture_output=True, text=True, timeout=180
    )
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout, done.stderr


def verify(folder, **where):
    return run("verify", folder / "scene.json", folder / "plan.json", **where)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no full device here")
def test_a_full_disk_behind_stdout_is_a_status_of_its_own(folder):
    status, _, err = verify(folder, shell="> /dev/full")
    assert (status, err) == (3, "flockopt: the machine refuses: No space left on device\n")
    assert verify(folder, shell="2> /dev/full")[0] == 0


def test_closed_streams_change_nothing(folder):
    assert verify(folder, shell="2>&-")[0] == 0
    assert verify(folder, shell=">&-")[0] == 0
    assert run("verify", folder / "scene.json", folder / "missing.json", shell="2>&- >&-")[0] == 2


def test_a_reader_who_leaves_early_is_no_fault(folder):
    status, out, err = verify(folder, shell="| head -1; exit ${PIPESTATUS[0]}")
    assert status == 0 and err == ""
    assert out.startswith("clause")


def test_no_home_and_no_place_for_compiled_code_are_no_fault(folder):
    nowhere = {"HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere", "NUMBA_CACHE_DIR": "", "TMPDIR": str(folder)}
    assert run("generate", "forest", "--drones", 2, "--tasks", 3, "-o", folder / "forest.json", **nowhere)[0] == 0
    assert run("show", folder / "forest.json", "-o", folder / "forest.html", **nowhere)[0] == 0


def test_letters_that_the_terminal_does_not_know_are_written_as_escapes(folder):
    record = json.loads((folder / "scene.json").read_text())
    record["name"] = "Zürich-Höngg"
    (folder / "odd.json").write_text(json.dumps(record))
    status, out, _ = run("plan", folder / "odd.json", "-o", folder / "odd-plan.json", "--planner", "classical",
                         PYTHONIOENCODING="ascii", PYTHONUTF8="0", LC_ALL="C")  # fmt: skip
    assert status == 0
    assert "Z\\xfcrich" in out


def test_files_go_through_pipes(folder):
    status, out, err = run("generate", "forest", "--drones", 2, "--tasks", 3, "--seed", 4, "-o", "-")
    assert status == 0
    scene = Scene.from_dict(json.loads(out))
    status, out, err = run("plan", "-", "-o", "-", "--planner", "classical", stdin="\ufeff" + out)
    assert status == 0
    made = Plan.from_dict(json.loads(out))
    assert made.scene_sha256 == scene.sha256
    assert "certified: every clause holds" in err
    scene.save(folder / "piped.json")
    status, out, _ = run("verify", folder / "piped.json", "-", stdin=json.dumps(made.to_dict()))
    assert status == 0 and "certified" in out


@pytest.mark.parametrize(
    ("arguments", "stdin", "words"),
    [
        (("verify", "-", "-"), "", "SCENE is - and so is PLAN"),
        (("plan", "-", "-o", "-"), "{", "stdin is not JSON"),
        (("plan", "-", "-o", "-"), '{"format": "flockopt.scene/1"}', "-: name is missing"),
    ],
)
def test_what_cannot_come_through_a_pipe_is_refused(arguments, stdin, words):
    status, out, err = run(*arguments, stdin=stdin)
    assert (status, out) == (2, "")
    assert words in err and err.count("\n") == 1
