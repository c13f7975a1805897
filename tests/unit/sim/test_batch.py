"""Batches of flights: nothing lost or counted twice, dead workers replaced, other backends the same numbers."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("pybullet", reason="pybullet comes with the extra 'sim'")

from flockopt import MissingExtra, SettingsError
from flockopt.batches.backends import BACKENDS, open_backend
from flockopt.batches.journal import ROWS
from flockopt.batches.workers import MOST_DEATHS
from flockopt.records.status import PLAN_STATUSES
from sim import evaluate
from sim.trials.batch import run_batch
from sim.trials.journal import Journal
from sim.trials.status import TrialStatus
from sim.trials.summary import flawless, summary_text
from sim.trials.trial import COLUMNS, Result, Trial, run_trial

ROOT = Path(__file__).resolve().parents[3]
FIRST = Trial("rooms", 2, 3, 0)
TRIALS = [replace(FIRST, seed=seed) for seed in range(6)]
SMALL = ["--family", "rooms", "--drones", "2", "--tasks", "3", "--scenes", "3", "--no-movie"]


def pretend(trial):
    return Result(trial.key, trial.blank_row() | {"status": "certified", "contacts": 0}, {"attempts": 1})


def stumble(trial, folder, deadly, times):
    """Kill the worker that flies the deadly trial, the first few times."""
    falls = len(list(folder.glob("fall-*")))
    if trial.seed == deadly and falls < times:
        (folder / f"fall-{falls}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return pretend(trial)


def test_a_journal_goes_on_where_it_was_cut(tmp_path):
    with Journal(tmp_path, FIRST.terms()) as journal:
        for trial in TRIALS[:2]:
            journal.add(pretend(trial))
            journal.add(pretend(trial))
    path = tmp_path / ROWS
    assert len(path.read_bytes().splitlines()) == 2
    path.write_bytes(path.read_bytes()[:-9])
    flown = []

    def work(trial):
        flown.append(trial.key)
        return pretend(trial)

    with Journal(tmp_path, FIRST.terms()) as journal:
        assert (TRIALS[0].key in journal, TRIALS[1].key in journal) == (True, False)
        run_batch(TRIALS, journal, backend="threading", work=work)
    assert flown == [trial.key for trial in TRIALS[1:]]
    with Journal(tmp_path, FIRST.terms()) as journal:
        assert sorted(journal.results) == sorted(trial.key for trial in TRIALS)


def test_a_folder_is_one_batchs_and_one_runs(tmp_path):
    with Journal(tmp_path, FIRST.terms()), pytest.raises(SettingsError, match="in use"), Journal(tmp_path, FIRST.terms()):
        pass
    with pytest.raises(SettingsError, match="holds flights with planner 'classical'"):
        Journal(tmp_path, replace(FIRST, planner="other").terms())


@pytest.mark.parametrize("times", [1, MOST_DEATHS])
def test_a_dead_worker_is_replaced_and_reported(tmp_path, times):
    warnings = []
    with Journal(tmp_path / "out", FIRST.terms()) as journal:
        work = partial(stumble, folder=tmp_path, deadly=2, times=times)
        run_batch(TRIALS, journal, jobs=2, work=work, warn=warnings.append)
        statuses = {key: result.row["status"] for key, result in journal.results.items()}
        deadly = journal.results[TRIALS[2].key]
    assert len(warnings) == times
    assert all(TRIALS[2].key in words for words in warnings)
    assert statuses.pop(deadly.key) == ("certified" if times < MOST_DEATHS else "error")
    assert set(statuses.values()) == {"certified"}
    assert len(statuses) == len(TRIALS) - 1
    assert deadly.timing["attempts"] == min(times + 1, MOST_DEATHS)


def test_what_flockopt_refuses_becomes_a_row():
    result = run_trial(replace(FIRST, planner="nobody"))
    assert result.row["status"] == "error"
    assert "planner is 'nobody'" in result.row["failed"]
    assert result.row["execution_completion"] == 0.0
    assert set(result.row) == set(COLUMNS)


def test_every_status_says_what_it_means_and_what_to_do():
    assert set(PLAN_STATUSES) < set(TrialStatus)
    for status in TrialStatus:
        assert status.text
        assert bool(status.mend) is (status is not TrialStatus.CERTIFIED)
    with pytest.raises(ValueError, match="'lost'"):
        TrialStatus("lost")


def test_the_journal_and_the_table_keep_the_words_of_statuses(tmp_path):
    result = run_trial(replace(FIRST, planner="nobody"))
    with Journal(tmp_path, {}) as journal:
        journal.add(result)
        journal.write_tables([result.key])
    with Journal(tmp_path, {}) as journal:
        row = journal.results[result.key].row
    assert (row["status"], type(row["status"])) == ("error", str)
    assert (tmp_path / "flights.csv").read_text().splitlines()[1].split(",")[2] == "error"
    last = summary_text("", [row], [result.timing]).splitlines()[-1]
    assert last.startswith(f"- {result.key}: error SettingsError: planner is 'nobody'")
    assert last.endswith(TrialStatus.ERROR.mend)


def test_evaluate_writes_what_it_says(tmp_path, capsys):
    assert evaluate.main([*SMALL, "--out", str(tmp_path)]) == 0
    assert "3 of 3 flights certified, complete and without contact" in capsys.readouterr().out
    with (tmp_path / "flights.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["scene"] for row in rows] == ["rooms-2x3-0", "rooms-2x3-1", "rooms-2x3-2"]
    for row in rows:
        assert (row["status"], row["planner_coverage"], row["execution_completion"], row["contacts"]) == (
            "certified",
            "1",
            "1",
            "0",
        )
        assert 0.0 < float(row["mean_tracking_error"]) < float(row["max_tracking_error"]) < 0.03
        assert float(row["min_clearance"]) > 0.05
    assert {"summary.md", "summary.png", "timings.csv"} <= {path.name for path in tmp_path.iterdir()}


def _kill_after_a_flight(words, folder):
    """Evaluate in a process of its own and kill it when its first flight is done."""
    command = [sys.executable, "-m", "sim.evaluate", *words]
    run = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rows = folder / ROWS
    while run.poll() is None and not (rows.exists() and rows.stat().st_size):
        time.sleep(0.005)
    run.kill()
    run.wait()


def test_killed_and_resumed_gives_the_same_table(tmp_path):
    clean, broken = tmp_path / "clean", tmp_path / "broken"
    assert evaluate.main([*SMALL, "--out", str(clean), "--backend", "threading", "--jobs", "2"]) == 0
    _kill_after_a_flight([*SMALL, "--out", str(broken)], broken)
    assert evaluate.main([*SMALL, "--out", str(broken)]) == 0
    assert (broken / "flights.csv").read_bytes() == (clean / "flights.csv").read_bytes()
    assert len((broken / ROWS).read_bytes().splitlines()) == 3


STRUCK = ["--family", "rooms", "--drones", "3", "--tasks", "5", "--scenes", "3", "--events", "3", "--no-movie"]


@pytest.fixture(scope="module")
def struck(tmp_path_factory):
    """A folder of flights that were struck by events."""
    folder = tmp_path_factory.mktemp("struck")
    assert evaluate.main([*STRUCK, "--out", str(folder)]) == 0
    return folder


def test_every_task_is_accounted_for_after_events(struck):
    with (struck / "flights.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    happened = ("tasks_added", "tasks_removed", "drones_lost", "drones_late", "gusts")
    for row in rows:
        assert sum(int(row[column]) for column in happened) == int(row["events"]) == 3
        assert (row["unexplained"], row["contacts"], row["swaps"]) == ("0", "0", row["swaps_certified"])
        assert float(row["execution_completion"]) == 1.0 or row["reasons"]
    assert sum(int(row["swaps"]) for row in rows) > 0
    assert "tasks neither served nor listed | 0" in (struck / "summary.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("backend", ["threading", "loky"])
def test_other_backends_give_the_same_events_and_numbers(struck, tmp_path, backend):
    assert evaluate.main([*STRUCK, "--out", str(tmp_path), "--backend", backend, "--jobs", "2"]) == 0
    assert (tmp_path / "flights.csv").read_bytes() == (struck / "flights.csv").read_bytes()


def test_killed_among_events_and_resumed_gives_the_same_table(struck, tmp_path):
    _kill_after_a_flight([*STRUCK, "--out", str(tmp_path)], tmp_path)
    assert evaluate.main([*STRUCK, "--out", str(tmp_path)]) == 0
    assert (tmp_path / "flights.csv").read_bytes() == (struck / "flights.csv").read_bytes()
    with pytest.raises(SettingsError, match="holds flights with events"):
        Journal(tmp_path, FIRST.terms() | {"drones": 3, "tasks": 5})


@pytest.mark.parametrize(
    ("row", "good"),
    [
        ({}, True), ({"unexplained": 1}, False), ({"swaps_certified": 1}, False), ({"contacts": 1}, False),
        ({"execution_completion": 0.9, "unserved": 1}, True), ({"events": 0, "execution_completion": 0.9}, False),
    ],
)  # fmt: skip
def test_flights_after_events_are_flawless_when_all_is_accounted_for(row, good):
    clean = {"status": "certified", "contacts": 0, "execution_completion": 1.0, "events": 4, "unexplained": 0}
    assert flawless(clean | {"swaps": 2, "swaps_certified": 2, "unserved": 0} | row) is good


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--family", "jungle"], "family is 'jungle'"),
        (["--planner", "oracle"], "planner is 'oracle'"),
        (["--backend", "carrier-pigeon"], "backend is 'carrier-pigeon'"),
        (["--vehicle", "kite"], "vehicle is 'kite'"),
        (["--controller", "pid"], "controller is 'pid'"),
        (["--scenes", "0"], "scenes is 0"),
        (["--seed", "-1"], "seed is -1"),
        (["--jobs", "0"], "jobs is 0"),
        (["--drones", "0"], "drones is 0"),
        (["--time-limit", "nan"], "time-limit is nan"),
        (["--events", "-1"], "events is -1"),
        (["--events", "2", "--event-kinds", "quake"], "kinds hold 'quake'"),
        (["--events", "2", "--gust", "0"], "gust_mps is 0"),
    ],
)
def test_bad_input_is_named_in_one_line(tmp_path, capsys, arguments, words):
    assert evaluate.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_backend_that_cannot_stream_flies_all_in_groups(tmp_path, monkeypatch):
    @contextmanager
    def in_groups(jobs):
        with BACKENDS["threading"](jobs) as backend:
            yield backend._replace(streams=False)

    monkeypatch.setitem(BACKENDS, "groups", in_groups)
    with Journal(tmp_path, FIRST.terms()) as journal:
        run_batch(TRIALS, journal, jobs=2, backend="groups", work=pretend)
        assert set(journal.results) == {trial.key for trial in TRIALS}


@pytest.mark.parametrize(("backend", "package"), [("dask", "dask"), ("ray", "ray")])
def test_a_missing_backend_names_its_extra(monkeypatch, backend, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtra, match="cluster"), open_backend(backend, 1):
        pass
