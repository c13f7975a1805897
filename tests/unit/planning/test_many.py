"""Many scenes: a row each, whatever happens to the others, and goes on where it was stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from flockopt import Plan, Scene, SettingsError, certify, generate, plan_many
from flockopt.cli.main import main
from flockopt.planning import many


def scenes(count, first=0):
    return [generate("forest", drones=2, tasks=3, seed=seed, size=(8.0, 8.0, 3.0)) for seed in range(first, first + count)]


def plain(rows):
    """What does not depend on the clock, in order."""
    return sorted((replace(row, seconds={}) for row in rows), key=lambda row: row.index)


@pytest.fixture(scope="module")
def one_by_one():
    return plain(plan_many(scenes(5), planner="classical"))


def test_a_row_a_scene(one_by_one):
    assert [row.status for row in one_by_one] == ["certified"] * 5
    assert [row.sha256 for row in one_by_one] == [scene.sha256 for scene in scenes(5)]
    assert all(0.0 <= row.gap < 0.1 and row.travel > 0.0 and row.makespan > 0.0 for row in one_by_one)


@pytest.mark.parametrize("workers", ["loky", "threading"])
def test_rows_do_not_depend_on_the_workers(one_by_one, workers):
    assert plain(plan_many(scenes(5), planner="classical", jobs=2, workers=workers)) == one_by_one


def test_scenes_are_taken_as_there_is_room():
    taken = []

    def endless():
        for seed in range(10**9):
            taken.append(seed)
            yield scenes(1, seed)[0]

    rows = plan_many(endless(), planner="classical")
    assert [next(rows).index for _ in range(3)] == [0, 1, 2]
    assert len(taken) <= 3 + many.AHEAD
    rows.close()


def test_a_scene_that_fails_is_a_row_and_the_others_go_on(tmp_path, monkeypatch):
    good, broken = scenes(2), tmp_path / "broken.json"
    broken.write_text("{}")
    plan = many.plan
    monkeypatch.setattr(many, "plan", lambda scene, settings: 1 / 0 if scene.num_tasks == 2 else plan(scene, settings))
    given = [good[0], broken, tmp_path / "none.json", good[1].replace(tasks=good[1].tasks[:2]), good[1]]
    rows = plain(plan_many(given, planner="classical"))
    assert [row.status for row in rows] == ["certified", "error", "error", "error", "certified"]
    assert rows[1].scene.endswith("broken.json") and "format is missing" in rows[1].reason
    assert "none.json" in rows[2].reason and "ZeroDivisionError" in rows[3].reason


def test_what_was_done_is_not_done_again(tmp_path, one_by_one, monkeypatch):
    rows = plan_many(scenes(5), planner="classical", out=tmp_path, keep_plans=True)
    begun = [next(rows) for _ in range(2)]
    rows.close()
    lines = (tmp_path / "rows.jsonl").read_text()
    assert [json.loads(line)["row"]["index"] for line in lines.splitlines()] == [row.index for row in begun]
    (tmp_path / "rows.jsonl").write_text(lines + '{"key": "2-')  # a kill in the middle of a line
    planned = []
    plan = many.plan
    monkeypatch.setattr(many, "plan", lambda scene, settings: planned.append(scene.name) or plan(scene, settings))
    assert plain(plan_many(scenes(5), planner="classical", out=tmp_path, keep_plans=True)) == one_by_one
    assert len(planned) == 3
    kept = sorted((tmp_path / "plans").iterdir())
    assert len(kept) == 5
    assert certify(scenes(1)[0], Plan.load(kept[0])).certified
    with pytest.raises(SettingsError, match="holds plans with seed 0"):
        list(plan_many(scenes(5), planner="classical", seed=1, out=tmp_path))


KILLED = """
import sys
from flockopt import generate, plan_many
scenes = (generate("forest", drones=2, tasks=3, seed=seed, size=(8.0, 8.0, 3.0)) for seed in range(400))
for row in plan_many(scenes, planner="classical", out=sys.argv[1]):
    print(row.index, flush=True)
"""


def test_a_killed_run_goes_on(tmp_path, root):
    environment = os.environ | {"PYTHONPATH": str(root)}
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], env=environment, stdout=subprocess.PIPE, text=True
    ) as running:
        for _ in range(3):
            running.stdout.readline()
        running.send_signal(signal.SIGKILL)
    done = len((tmp_path / "rows.jsonl").read_text().splitlines())
    assert 3 <= done < 400
    rows = plan_many(scenes(done + 1), planner="classical", out=tmp_path)
    began = time.perf_counter()
    assert len(list(rows)) == done + 1
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == done + 1
    assert time.perf_counter() - began < 60.0


def killing(job, *, settings, plans):
    if job.index == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return many.PlanRow(job.index, job.scene.name, job.scene.sha256, "certified")


def test_a_scene_that_kills_its_worker_is_a_row_too(monkeypatch):
    monkeypatch.setattr(many, "_work", killing)
    rows = plain(plan_many(scenes(5), planner="classical", jobs=2))
    assert [row.status for row in rows] == ["certified", "error", "certified", "certified", "certified"]
    assert rows[1].reason == "it brought two workers down"


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"jobs": 0}, "jobs is 0"), ({"workers": "cloud"}, "workers is 'cloud'"), ({"keep_plans": True}, "keep_plans is set"),
        ({"planner": "nobody"}, "nobody"), ({"sed": 1}, "did you mean seed"),
    ],
)  # fmt: skip
def test_bad_settings_are_told_before_any_scene_is_taken(keywords, words):
    with pytest.raises(SettingsError, match=words):
        plan_many(iter([None]), **keywords)


def test_the_command_plans_folders_and_files(tmp_path, capsys):
    folder = tmp_path / "scenes"
    folder.mkdir()
    for index, scene in enumerate(scenes(2)):
        scene.save(folder / f"{index}.json")
    scenes(3)[2].save(tmp_path / "third.json")
    command = ["plan-many", str(folder), str(tmp_path / "third.json"), "-o", str(tmp_path / "study"), "--planner", "classical"]
    assert main(command) == 0
    out = capsys.readouterr()
    assert "certified" in out.out and "3" in out.out and "3/3" in out.err
    assert main([*command, "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    (folder / "1.json").write_text("{}")
    assert main(command) == 1
    assert "1.json" in capsys.readouterr().err
    assert main(["plan-many", str(tmp_path / "study" / "plans-none"), "-o", str(tmp_path / "other")]) == 1
    assert Scene.load(folder / "0.json").num_tasks == 3
