"""The student's benchmarks run to the end on one scene, and their tables hold what their rows do."""

from __future__ import annotations

import csv

import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from benchmarks import pipeline, scalability, student_ablation, way_finders  # noqa: E402 - torch may be missing
from flockopt import MissingExtra, Scene  # noqa: E402 - torch may be missing
from learned.student.checkpoint import save_student  # noqa: E402
from tests.student_scenes import tiny_student  # noqa: E402


def rows_of(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_ablation_counts_blocked_drones(tmp_path, monkeypatch):
    student = tiny_student("small")
    save_student(tmp_path / "tiny.safetensors", student.state_dict(), student.settings, {})
    monkeypatch.setattr(student_ablation, "VARIANTS", ((0, 1), (2, 1)))
    monkeypatch.setattr(student_ablation, "ITERATIONS", (0,))
    command = ["--scenes", "1", "--weights", str(tmp_path / "tiny.safetensors"), "--out", str(tmp_path)]
    assert student_ablation.main(command) == 0
    straight, drawn = (row for row in rows_of(tmp_path / "trajectories.csv") if row["kind"] == "hard")
    assert int(straight["blocked"]) > 0 and int(straight["blocked_clear"]) == 0
    assert int(straight["drones_clear"]) == int(straight["drones"]) - int(straight["blocked"])
    assert drawn["blocked"] == straight["blocked"]
    assert {row["preferences"] for row in rows_of(tmp_path / "allocation.csv")} == {"head", "nearness", "none"}
    assert "straight lines" in (tmp_path / "summary.md").read_text(encoding="utf-8")


def test_scalability_certifies_what_it_times(tmp_path, monkeypatch):
    def missing(student):
        raise MissingExtra("openvino", "openvino")  # compiling takes longer than all else here

    monkeypatch.setattr(way_finders, "shipped_student", lambda: tiny_student("small"))
    monkeypatch.setattr(way_finders, "_compiled", missing)
    monkeypatch.setattr(way_finders, "BATCH", 3)
    monkeypatch.setattr(scalability, "WARM_UP", 1)
    assert scalability.main(["--scenes", "1", "--tasks", "8", "12", "--out", str(tmp_path)]) == 0
    rows = rows_of(tmp_path / "scalability.csv")
    assert [row["pipeline"] for row in rows] == [name for name in scalability.NAMES if name != way_finders.OPENVINO] * 2
    assert all(row["certified"] == "True" for row in rows if not row["pipeline"].startswith("voxel"))
    assert (tmp_path / "scalability.png").stat().st_size > 0


def test_the_pipelines_find_scenes_in_which_the_hybrid_is_worse():
    def row(name, scene, travel, coverage=1.0):
        return {"pipeline": name, "scene": scene, "travel": travel, "coverage": coverage}

    rows = [row("classical", scene, 10.0) for scene in "abc"]
    rows += [row("hybrid", "a", 10.0), row("hybrid", "b", 10.1), row("hybrid", "c", 8.0, coverage=0.9)]
    assert pipeline._worse(rows, "") == ["b", "c"] and pipeline._worse(rows, ", limited") == []


def test_a_pipeline_is_measured_and_flown(two_drones):
    scene = Scene.from_dict(two_drones)
    measured = pipeline._measured(scene, pipeline.PIPELINES["classical"], 0, None)
    assert measured["certified"] and measured["coverage"] == measured["completion"] == 1.0
    assert measured["contacts"] == 0.0 < measured["room"] and measured["route_cost"] == pytest.approx(measured["travel"])
    cells = [pipeline._cell(*of) for of in (("room", [3.0, 1.0]), ("contacts", [2.0, 1.0]), ("coverage", [1.0, float("nan")]))]
    assert cells == [1.0, 3.0, 100.0]
