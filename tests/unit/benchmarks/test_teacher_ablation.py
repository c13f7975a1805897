"""The ablation of teachers: its figures by hand, its flights with allocators that are not learned."""

from __future__ import annotations

import csv
from collections import namedtuple

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet comes with the extra 'sim'")

from benchmarks import teacher_ablation
from benchmarks.allocators import nearest_task
from benchmarks.table_one import summary
from benchmarks.teacher_ablation import main
from flockopt import compute_travel, refine_bundles
from learned.teacher import planner
from tests.flights import drone, make_scene

Allocation = namedtuple("Allocation", "routes steps")

SMALL = ["--scenes", "2", "--drones", "2", "--tasks", "4", "--families", "forest", "rooms", "--backend", "threading"]


@pytest.fixture
def allocators(monkeypatch):
    """MAGNNET takes one task a drone; the others the search's first solution."""

    class Allocator:
        def __init__(self, method):
            self.method = method

        def bundles(self, scenes, travels):
            if self.method == "magnnet":
                return [Allocation(tuple((drone,) for drone in range(scenes[0].num_drones)), 2)]
            return [Allocation(refine_bundles(scenes[0], travel=travels[0], iterations=0).routes, 3)]

    monkeypatch.setattr(planner, "allocator", Allocator)


def test_nearest_task_is_greedy_by_hand():
    scene = make_scene(
        [drone(0, (1, 1, 1), capacity=2), drone(1, (9, 1, 1), capacity=2)], [(3, 1, 1), (4, 1, 1), (8.5, 1, 1), (4.5, 1, 1)]
    )
    bundles = nearest_task(scene, compute_travel(scene), 0)
    # 0.5 m: drone 1 to task 2; 2 m: drone 0 to task 0; 1 m: on to task 1; drone 0 is full, so drone 1 comes back for task 3
    assert bundles.routes == ((0, 1), (2, 3))


def test_all_methods_are_flown_and_told_apart(allocators, tmp_path, capsys):
    assert main([*SMALL, "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "50.0 ± 0.0 (50)" in told
    assert "Optima proven: 2 of 2" in told
    with (tmp_path / "teacher_ablation.csv").open(encoding="utf-8") as file:
        rows = {(row["method"], row["scene"]): row for row in csv.DictReader(file)}
    assert len(rows) == 2 * len(teacher_ablation.METHODS)
    for (method, scene), row in rows.items():
        exact = rows["exact", scene]
        assert scene.split("-")[-1] in ("0", "1")
        assert float(row["execution_completion"]) == (0.5 if method == "magnnet" else 1.0)
        assert float(row["cost_voxel6"]) > float(row["cost_voxel26"]) > float(row["cost"])
        if method == "magnnet":
            assert row["gap_to_optimum"] == ""
        else:
            gap = float(row["cost"]) / float(exact["cost"]) - 1.0
            assert float(row["gap_to_optimum"]) == pytest.approx(gap, abs=1e-4)
    assert (tmp_path / "teacher_ablation.png").stat().st_size > 1000


def test_what_was_flown_is_not_flown_again(allocators, tmp_path, monkeypatch, capsys):
    arguments = [*SMALL, "--methods", "nearest", "--out", str(tmp_path)]
    assert main(arguments) == 0
    first = (tmp_path / "teacher_ablation.csv").read_bytes()
    monkeypatch.setattr(teacher_ablation, "run_trial", lambda trial: pytest.fail("flown again"))
    assert main(arguments) == 0
    assert (tmp_path / "teacher_ablation.csv").read_bytes() == first
    assert main([*arguments, "--tasks", "5"]) == 2
    assert "holds flights with tasks 4" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--scenes", "0"], "scenes is 0"), (["--seed", "-1"], "seed is -1"), (["--jobs", "0"], "jobs is 0")],
)
def test_bad_input_is_named(tmp_path, capsys, arguments, words):
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err


def record(method, scene, cost, completion=1.0):
    return {
        "method": method, "scene": scene, "family": "forest", "cost": cost, "execution_completion": completion,
        "status": "certified", "failed": "",
    }  # fmt: skip


def test_means_confidence_and_reductions_by_hand():
    costs = {"magnnet-bundling": (100.0, 110.0, 120.0), "teacher": (90.0, 99.0, 108.0)}
    text = summary([record(method, f"s{place}", cost) for method, three in costs.items() for place, cost in enumerate(three)])
    half = 1.96 * 10.0 / np.sqrt(3)
    assert f"110.00 ± {half:.2f} (338.80)" in text
    assert f"99.00 ± {0.9 * half:.2f} (310.22)" in text
    assert "| route cost, m | 8.4 | 10.0 (10.0 to 10.0) |" in text
    text = summary([record("teacher", "s0", 90.0, completion=0.5)])
    assert "- teacher s0: certified" in text
