"""The command that plans many scenes: rows in a folder, a summary, and exit statuses that say what came of them."""

from __future__ import annotations

import csv
import json

import pytest

from flockopt import Plan, generate


@pytest.fixture
def scenes(tmp_path):
    """A folder of three scene files."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    for seed in range(3):
        generate("rooms", drones=2, tasks=3, seed=seed).save(folder / f"{seed}.json")
    return folder


def table(folder):
    with (folder / "rows.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_it_writes_rows_and_says_what_they_amount_to(flockopt, scenes, tmp_path):
    out = tmp_path / "out"
    status, words, progress = flockopt("plan-many", scenes, "--planner", "classical", "--seed", 3, "--out", out, "--keep-plans")
    assert status == 0
    assert words.startswith("3 scenes: 3 certified\n") and str(out / "rows.csv") in words
    assert [line.split()[0] for line in words.splitlines()[4:8]] == ["cost,", "gap", "makespan,", "planning,"]
    assert progress.rstrip().endswith("3/3  rooms-2x3-2 certified")
    rows = table(out)
    assert [row["source"] for row in rows] == [str(scenes / f"{seed}.json") for seed in range(3)]
    assert {(row["seed"], row["planner"]) for row in rows} == {("3", "classical")}
    assert all(Plan.load(out / row["plan"]).status == "certified" for row in rows)
    assert len((out / "rows.jsonl").read_text().splitlines()) == 3


def test_what_is_not_certified_is_named_and_stops_nothing(flockopt, scenes, tmp_path):
    (scenes / "1.json").write_text("{", encoding="utf-8")
    out = tmp_path / "out"
    status, words, _ = flockopt("plan-many", scenes, "--planner", "classical", "--out", out, "--jobs", 2)
    assert status == 1
    assert words.startswith("3 scenes: 2 certified, 1 error\n")
    assert f"{scenes / '1.json'}: error: SceneError: {scenes / '1.json'} is not JSON" in words
    generate("rooms", drones=2, tasks=3, seed=1).save(scenes / "1.json")
    assert flockopt("plan-many", scenes, "--planner", "classical", "--out", out, "--quiet") == (0, "", "")
    assert [row["status"] for row in table(out)] == ["certified"] * 3
    keys = [json.loads(line)["key"] for line in (out / "rows.jsonl").read_text().splitlines()]
    assert len(keys) == 4  # the two that stood were not planned again


def test_no_more_than_ten_are_named(flockopt, tmp_path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    for number in range(12):
        (folder / f"{number:02}.json").touch()
    status, words, _ = flockopt("plan-many", folder, "--planner", "classical", "--out", tmp_path / "out")
    assert status == 1 and words.count("is not JSON") == 10 and "\nand 2 more\n" in words


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--jobs", "0"], "--jobs is '0'"), (["--workers", "cloud"], "--workers is 'cloud'"),
     (["--planner", "oracle"], "planner is 'oracle'"),
     (["--paths", "voxel6", "--planner", "classical"], "paths is 'voxel6'"), (["nowhere"], "scenes are nowhere")],
)  # fmt: skip
def test_bad_input_is_one_line_and_writes_nothing(flockopt, scenes, tmp_path, arguments, words):
    status, out, error = flockopt("plan-many", scenes, *arguments, "--out", tmp_path / "out")
    assert (status, out) == (2, "")
    assert words in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_rows_are_not_written_among_the_scenes(flockopt, scenes):
    before = sorted(scenes.iterdir())
    status, _, error = flockopt("plan-many", scenes, "--planner", "classical", "--out", f"{scenes}/")
    assert status == 2 and "must not be a folder of scenes" in error and sorted(scenes.iterdir()) == before


def test_a_folder_of_another_study_is_refused(flockopt, scenes, tmp_path):
    arguments = ["plan-many", scenes, "--planner", "classical", "--out", tmp_path / "out", "--quiet"]
    assert flockopt(*arguments)[0] == 0
    status, _, error = flockopt(*arguments, "--bound", "fast")
    assert status == 2 and "holds plans with bound 'tight'; this run has 'fast'" in error
