"""The comparison of laws: what it writes, and that it sees what is wrong."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from benchmarks import trajectories
from benchmarks.flight_measures import squared_jerk
from flockopt.flights import Flight, Visit

pytest.importorskip("matplotlib", reason="matplotlib comes with the extra 'show'")


def rows(folder):
    with (folder / "trajectories.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_law_flies_the_same_bundles(tmp_path, capsys):
    pytest.importorskip("ruckig", reason="ruckig comes with the extra 'trajectory'")
    assert trajectories.main(["--scenes", "2", "--size", "3x6", "--out", str(tmp_path)]) == 0
    table = rows(tmp_path)
    assert [row["law"] for row in table] == list(trajectories.LAWS) * 2
    assert {row["status"] for row in table} == {"ok"}
    by_law = {row["law"]: row for row in table[:3]}
    assert len({row["bound"] for row in table[:3]}) == 1
    assert float(by_law["quintic"]["makespan"]) > 1.5 * float(by_law["fly-through"]["makespan"])
    assert 0.0 < float(by_law["quintic"]["fit_error"]) < 0.02
    assert (tmp_path / "trajectories.png").stat().st_size > 10_000
    text = (tmp_path / "summary.md").read_text(encoding="utf-8")
    assert "python -m benchmarks.trajectories" in text
    assert "below the quintic law's" in text
    assert text in capsys.readouterr().out


def too_fast(scene, bundles, travel):
    flights = trajectories.LAWS["fly-through"](scene, bundles, travel)
    return {name: Flight(flight.curve.stretched(0.8), flight.visits) for name, flight in flights.items()}


def elsewhere(scene, bundles, travel):
    flights = trajectories.LAWS["fly-through"](scene, bundles, travel)
    late = {name: tuple(Visit(v.task, v.time + 0.1) for v in flight.visits[:1]) for name, flight in flights.items()}
    return {name: Flight(flight.curve, late[name]) for name, flight in flights.items()}


@pytest.mark.parametrize(("law", "fault"), [(too_fast, "speed_margin"), (elsewhere, "visit_error")])
def test_a_law_that_breaks_a_rule_fails(law, fault, tmp_path, monkeypatch):
    monkeypatch.setitem(trajectories.LAWS, "broken", law)
    arguments = ["--scenes", "1", "--size", "3x6", "--laws", "fly-through", "broken", "--out", str(tmp_path)]
    assert trajectories.main(arguments) == 1
    fine, broken = rows(tmp_path)
    assert fine["status"] == "ok"
    assert broken["status"] == "failed"
    assert fault in broken["failed"].split()


def test_squared_jerk_is_integrated_exactly():
    from flockopt.flights import Curve

    curve = Curve(np.array([0.0, 2.0]), np.array([[[0, 0, 0, 0, 1.0], [0, 0, 0, 1.0, 0], [0.0] * 5]]))
    assert squared_jerk(curve) == pytest.approx(24**2 * 2**3 / 3 + 36 * 2)
