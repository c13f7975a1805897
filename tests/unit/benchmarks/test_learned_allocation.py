"""The benchmark of learned allocations on a few scenes."""

from __future__ import annotations

import csv

import pytest

pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from benchmarks.learned_allocation import main


def test_a_few_scenes(tmp_path, capsys):
    assert main(["--scenes", "2", "--seed", "3", "--out", str(tmp_path)]) == 0
    with (tmp_path / "learned_allocation.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["scene"] for row in rows} == {"forest-10x20-3", "corridor-10x20-3"}
    assert all(float(row["cost"]) >= float(row["reference"]) * (1 - 1e-6) for row in rows)
    cost = {(row["scene"], row["method"]): float(row["cost"]) for row in rows}
    assert all(cost[scene, "teacher, refined"] <= cost[scene, "teacher"] + 1e-6 for scene, _ in cost)
    assert "nearest task, one each" in capsys.readouterr().out


def test_missing_weights_are_bad_input(tmp_path, capsys):
    assert main(["--scenes", "1", "--teacher", str(tmp_path / "none"), "--out", str(tmp_path)]) == 2
    assert "none cannot be read" in capsys.readouterr().err
