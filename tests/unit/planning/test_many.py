"""Many scenes: the same rows however they are planned, none lost or planned twice, none stopped by another."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import pickle
import signal
import subprocess
import sys
import time

import pytest

from flockopt import Bundles, Plan, Planner, PlanRow, Proposal, Scene, SettingsError, certify, generate, plan, plan_many
from flockopt.batches.deadline import OutOfTime
from flockopt.batches.journal import ROWS
from flockopt.planning.many import PLANS, TABLE, TOGETHER, scene_files
from flockopt.planning.planners import PLANNERS
from tests.flights import drone, make_scene

CLASSICAL = PLANNERS["classical"]


def rooms(seed):
    return generate("rooms", drones=2, tasks=3, seed=seed)


SCENES = [rooms(seed) for seed in range(6)]


def refusing(request):
    """A planner that fails in several ways."""
    if request.scene.name == SCENES[1].name:
        raise ZeroDivisionError("no way")
    if request.scene.name == SCENES[2].name:
        raise SettingsError("seed", "is odd", "must be even", "double it")
    return CLASSICAL.propose(request)


def lines(folder):
    return [json.loads(line) for line in (folder / ROWS).read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="module")
def rows():
    """The rows of the scenes, planned one after another."""
    return list(plan_many(SCENES, planner="classical", seed=3))


def test_rows_are_those_of_plans(rows):
    for row, scene in zip(rows, SCENES, strict=True):
        made = plan(scene, planner="classical", seed=3)
        assert (row.scene, row.digest, row.drones, row.tasks) == (scene.name, scene.sha256, 2, 3)
        assert (row.planner, row.seed, row.status, row.certified) == ("classical", 3, made.status, True)
        assert (row.cost, row.bound, row.gap) == (made.cost.travel, made.cost.lower_bound, made.cost.gap)
        assert (row.length, row.makespan, row.unserved, row.reason) == (made.cost.length, made.cost.makespan, 0, "")
        assert row.seconds.keys() == made.timing.keys() and row.seconds["total"] > 0.0


@pytest.mark.parametrize("workers", ["loky", "threading"])
def test_rows_do_not_depend_on_who_plans(rows, tmp_path, workers):
    assert list(plan_many(SCENES, planner="classical", seed=3, jobs=2, workers=workers, out=tmp_path)) == rows
    assert {line["digest"] for line in lines(tmp_path)} == {scene.sha256 for scene in SCENES}
    with (tmp_path / TABLE).open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert [line["scene"] for line in table] == [scene.name for scene in SCENES]
    assert [float(line["cost"]) for line in table] == pytest.approx([row.cost for row in rows])
    assert all(float(line["total_s"]) > 0.0 and line["certified"] == "True" for line in table)


def test_a_row_is_a_record_in_files_and_between_processes(rows):
    row = rows[0]
    assert pickle.loads(pickle.dumps(row)) == row == PlanRow.from_dict(json.loads(json.dumps(row.to_dict())))
    assert dataclasses.replace(row, seconds={}) == row != dataclasses.replace(row, cost=0.0)


def test_scenes_are_taken_as_rows_are_read(tmp_path):
    taken = []

    def source():
        for seed in range(10**9):
            taken.append(seed)
            yield rooms(seed)

    study = plan_many(source(), planner="classical", out=tmp_path)
    assert taken == []
    for _ in range(4):
        next(study)
    study.close()
    assert 4 <= len(taken) <= 10 and not (tmp_path / TABLE).exists()
    assert len(lines(tmp_path)) == 4
    again = list(plan_many(SCENES, planner="classical", out=tmp_path))
    assert len(lines(tmp_path)) == 6 and [row.scene for row in again] == [scene.name for scene in SCENES]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_scene_that_fails_is_a_row_and_stops_no_other(rows, tmp_path, jobs):
    short = make_scene([drone(0, (1, 1, 1), capacity=1)], [(3, 3, 1), (5, 5, 1)])
    broken = tmp_path / "broken.json"
    broken.write_text('{"format": "flockopt.scene/1"}', encoding="utf-8")
    sources = [*SCENES[:3], short, broken, tmp_path / "missing.json", SCENES[3]]
    found = list(plan_many(sources, planner=Planner(refusing), seed=3, jobs=jobs, out=tmp_path / "out"))
    assert [row.status for row in found] == ["certified", "error", "error", "infeasible", "error", "error", "certified"]
    assert found[1].reason == "ZeroDivisionError: no way" and found[1].digest == SCENES[1].sha256
    assert "seed is odd; must be even; double it" in found[2].reason
    assert found[3].reason and found[3].cost is None and found[3].unserved
    assert (found[4].scene, found[4].source, found[4].digest) == ("broken", str(broken), "")
    assert "is missing" in found[4].reason and "cannot be read" in found[5].reason
    assert found[6].cost == rows[3].cost
    assert len((tmp_path / "out" / TABLE).read_text().splitlines()) == 8


def leaving(request):
    """A planner that serves one task."""
    return Proposal(Bundles(((0,), ()), ((1, "left"), (2, "left")), "incomplete", "two are left"))


def late(request):
    """A planner that is never done."""
    raise OutOfTime("dreaming")


def test_a_plan_that_is_not_certified_says_why():
    (row,) = plan_many(SCENES[0], planner=Planner(leaving))
    assert (row.status, row.certified, row.unserved, row.bound) == ("uncertified", False, 2, None)
    assert row.reason == "two are left; the certificate fails: coverage" and row.cost > 0.0
    (row,) = plan_many(SCENES[0], planner=Planner(late))
    assert (row.status, row.certified, row.cost, row.makespan) == ("uncertified", False, None, None)
    assert "dreaming" in row.reason and "give it more time" in row.reason


def test_errors_are_tried_again_and_nothing_else_is(tmp_path):
    first = list(plan_many(SCENES[:4], planner=Planner(refusing, "fickle"), out=tmp_path))
    asked = []

    def mended(request):
        asked.append(request.scene.name)
        return CLASSICAL.propose(request)

    second = list(plan_many(SCENES[:4], planner=Planner(mended, "fickle"), out=tmp_path))
    assert [row.status for row in first] == ["certified", "error", "error", "certified"]
    assert all(row.certified for row in second) and asked == [SCENES[1].name, SCENES[2].name]
    assert second == list(plan_many(SCENES[:4], planner=Planner(refusing, "fickle"), out=tmp_path))
    assert len(lines(tmp_path)) == 6


def test_a_scene_that_comes_twice_is_planned_once(tmp_path):
    paths = [tmp_path / f"{name}.json" for name in "ab"]
    for path in paths:
        SCENES[0].save(path)
    found = list(plan_many([SCENES[0], *paths, SCENES[0]], planner="classical", out=tmp_path / "out"))
    assert [row.source for row in found] == ["", *map(str, paths), ""]
    assert len({dataclasses.replace(row, source="").cost for row in found}) == 1
    assert len(lines(tmp_path / "out")) == 1


def test_what_a_source_raises_comes_after_the_rows_before_it(tmp_path):
    def source():
        yield from SCENES[:3]
        raise ZeroDivisionError

    found = []
    with pytest.raises(ZeroDivisionError):
        found.extend(plan_many(source(), planner="classical", jobs=2, out=tmp_path))
    assert len(lines(tmp_path)) == 3 and not (tmp_path / TABLE).exists()
    with pytest.raises(SettingsError, match=r"scenes\[1\] is 7; must be a Scene or the path"):
        list(plan_many([SCENES[0], 7], planner="classical", out=tmp_path))


CHILD = """
import sys
from flockopt import generate, plan_many
scenes = (generate("rooms", drones=2, tasks=3, seed=seed) for seed in range(6))
for row in plan_many(scenes, planner="classical", seed=3, out=sys.argv[1], jobs=int(sys.argv[2])):
    pass
"""


@pytest.mark.parametrize(("jobs", "ending"), [(1, signal.SIGKILL), (2, signal.SIGKILL), (2, signal.SIGINT)])
def test_stopped_and_started_again_it_goes_on(rows, tmp_path, jobs, ending):
    run = subprocess.Popen([sys.executable, "-c", CHILD, str(tmp_path), str(jobs)], stderr=subprocess.DEVNULL)
    journal = tmp_path / ROWS
    while run.poll() is None and not (journal.exists() and journal.stat().st_size):
        time.sleep(0.002)
    run.send_signal(ending)
    run.wait()
    before = [line["key"] for line in lines(tmp_path)] if journal.read_bytes().endswith(b"\n") else []
    assert list(plan_many(SCENES, planner="classical", seed=3, out=tmp_path)) == rows
    after = [line["key"] for line in lines(tmp_path)]
    assert after[: len(before)] == before and len(after) == len({*after}) == 6


def test_progress_is_told_of_what_is_counted_and_of_what_is_not(capsys):
    list(plan_many(SCENES, planner="classical", progress=True))
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"6/6  {SCENES[-1].name} certified")
    list(plan_many(iter(SCENES), planner="classical", progress=True))
    told = [line.split()[:2] for line in capsys.readouterr().err.splitlines()]
    assert told == [["1", "done"], ["2", "done"], ["4", "done"]]
    list(plan_many(SCENES, planner="classical"))
    assert capsys.readouterr().err == ""


def test_a_folder_is_one_studys(tmp_path):
    list(plan_many(SCENES[:1], planner="classical", out=tmp_path))
    with pytest.raises(SettingsError, match="holds plans with seed 0; this run has 1"):
        list(plan_many(SCENES[:1], planner="classical", seed=1, out=tmp_path))
    with pytest.raises(SettingsError, match="holds plans with planner 'classical'"):
        list(plan_many(SCENES[:1], planner="exact", out=tmp_path))


def test_plans_are_kept_where_that_is_asked_for(rows, tmp_path):
    found = list(plan_many(SCENES[:3], planner="classical", seed=3, jobs=2, out=tmp_path, keep_plans=True))
    assert len(list((tmp_path / PLANS).iterdir())) == 3
    for row, scene in zip(found, SCENES, strict=False):
        kept = Plan.load(tmp_path / row.plan)
        assert certify(scene, kept).certified and kept.cost.travel == row.cost
        assert dataclasses.replace(row, plan="") == rows[SCENES.index(scene)]


def test_folders_stand_for_their_files(tmp_path):
    for name, scene in zip(("b", "a"), SCENES, strict=False):
        scene.save(tmp_path / f"{name}.json")
    (tmp_path / "notes.txt").touch()
    assert [path.name for path in scene_files(tmp_path, tmp_path / "b.json")] == ["a.json", "b.json", "b.json"]
    assert [row.scene for row in plan_many(tmp_path, planner="classical")] == [SCENES[1].name, SCENES[0].name]
    (tmp_path / "empty").mkdir()
    for name, words in (("nowhere", "is not there"), ("empty", "holds no .json file")):
        with pytest.raises(SettingsError, match=f"scenes are .*{name}, which {words}"):
            plan_many(tmp_path / name)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [({"planner": "oracle"}, "planner is 'oracle'"), ({"jobs": 0}, "jobs is 0"), ({"workers": "cloud"}, "workers is 'cloud'"),
     ({"keep_plans": True}, "keep_plans is true without a folder"), ({"sed": 1}, "did you mean seed"),
     ({"paths": "voxel6", "planner": "classical"}, "paths is 'voxel6'")],
)  # fmt: skip
def test_what_is_wrong_with_all_scenes_is_said_at_once(keywords, words):
    with pytest.raises(SettingsError, match=words):
        plan_many(SCENES, **keywords)


def batched(asked, spoiled=""):
    """The classical planner, for many at once, and who was asked about together."""

    def propose_many(requests):
        asked.append([request.scene.name for request in requests])
        if any(request.scene.name == spoiled for request in requests):
            raise ValueError("spoiled")
        return [CLASSICAL.propose(request) for request in requests]

    return Planner(CLASSICAL.propose, "classical", propose_many=propose_many)


def test_a_planner_that_can_is_asked_about_many_at_once(tmp_path):
    scenes = [rooms(seed) for seed in range(TOGETHER + 3)]
    asked = []
    found = list(plan_many(scenes, planner=batched(asked), out=tmp_path))
    assert asked == [[scene.name for scene in scenes[:TOGETHER]], [scene.name for scene in scenes[TOGETHER:]]]
    assert found == list(plan_many(scenes, planner="classical"))
    assert all(row.seconds["total"] >= row.seconds["allocate"] > 0.0 for row in found)
    journal = tmp_path / ROWS
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[: TOGETHER + 1]))
    asked.clear()
    assert list(plan_many(scenes, planner=batched(asked), out=tmp_path)) == found
    assert asked == [[scene.name for scene in scenes[TOGETHER:]]]  # with the same company as before
    asked.clear()
    list(plan_many(scenes[:3], planner=batched(asked), time_limit_s=1e-3))
    assert asked == []


def test_a_batch_holds_a_scene_once():
    asked = []
    found = list(plan_many([SCENES[0], SCENES[0], SCENES[1], SCENES[0]], planner=batched(asked)))
    assert asked == [[SCENES[0].name, SCENES[1].name]]
    assert [row.scene for row in found] == [SCENES[number].name for number in (0, 0, 1, 0)]


def test_one_that_spoils_its_company_is_planned_alone():
    found = list(plan_many(SCENES, planner=batched([], spoiled=SCENES[2].name), seed=3))
    assert [row.status for row in found] == ["certified"] * 2 + ["error"] + ["certified"] * 3
    assert found[2].reason == "ValueError: spoiled"


def killing(request):
    """A planner that one scene kills, with all the process."""
    if request.scene.name == SCENES[2].name:
        os.kill(os.getpid(), signal.SIGKILL)
    return CLASSICAL.propose(request)


def killing_many(requests):
    return [killing(request) for request in requests]


@pytest.mark.slow
@pytest.mark.parametrize("propose_many", [None, killing_many])
def test_a_scene_that_kills_its_workers_is_given_up_alone(rows, tmp_path, propose_many):
    planner = Planner(killing, "classical", propose_many=propose_many)
    found = list(plan_many(SCENES, planner=planner, seed=3, jobs=2, out=tmp_path))
    assert found[2].status == "error" and found[2].reason == "it brought 3 workers down"
    assert found[:2] + found[3:] == rows[:2] + rows[3:]


def test_a_grounded_drone_in_the_way_spoils_no_batch():
    hopeless = make_scene([drone(0, (3, 3, 1), capacity=0), drone(1, (1, 1, 1))], [(3, 3.2, 1)])
    found = list(plan_many([SCENES[0], hopeless, SCENES[1]], planner=batched([])))
    assert [row.status for row in found] == ["certified", "infeasible", "certified"]


def test_scenes_far_from_zero_are_handed_back_from_a_batch():
    record = make_scene([drone(0, (1, 1, 1))], [(5, 5, 1)]).to_dict()
    bounds = record["bounds"]
    places = ["lower", "upper"]
    for owner, name in [(bounds, place) for place in places] + [
        (record["drones"][0], "start"),
        (record["tasks"][0], "position"),
    ]:
        x, y, z = owner[name]
        owner[name] = [x + 500_000.0, y, z]
    found = list(plan_many([SCENES[0], Scene.from_dict(record)], planner=batched([])))
    assert [row.certified for row in found] == [True, True]
