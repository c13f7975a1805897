"""The optimality benchmark: what it writes, on scenes small enough for a test."""

import csv

import numpy as np
import pytest

from benchmarks import optimality_gap
from benchmarks.allocators import allocator
from flockopt import SettingsError
from flockopt.bundles import Bundles


def rows_of(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def forgetful(scene, travel, seed):
    """A planner that leaves every task out."""
    return Bundles(((),) * scene.num_drones)


def one_takes_all(scene, travel, seed):
    """A planner that knows no capacities."""
    return Bundles((tuple(range(scene.num_tasks)),) + ((),) * (scene.num_drones - 1))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("gap")
    methods = f"greedy,exact,{__name__}:forgetful,{__name__}:one_takes_all"
    status = optimality_gap.main(
        ["--scenes", "2", "--sizes", "2x6", "--methods", methods, "--out", str(out), "--obstacles", "without"]
    )
    return status, out


def test_rows_have_the_columns_and_gaps_that_follow_from_them(written):
    rows = rows_of(written[1] / "optimality_gap.csv")
    assert list(rows[0]) == ["scene", "drones", "tasks", "method", "seconds", "cost", "bound", "bound_kind", "optimal", "gap"]
    for row in (row for row in rows if row["method"] in ("greedy", "exact")):
        assert float(row["gap"]) == pytest.approx(float(row["cost"]) / float(row["bound"]) - 1, abs=2e-5)
        assert row["bound_kind"] == "optimum"
    assert all(row["optimal"] == "True" and float(row["gap"]) == 0 for row in rows if row["method"] == "exact")


def test_failures_keep_their_rows_and_fail_the_run(written):
    status, out = written
    failed = [row for row in rows_of(out / "optimality_gap.csv") if ":" in row["method"]]
    assert status == 1 and len(failed) == 4
    assert all(row["cost"] == row["gap"] == "" and row["optimal"] == "False" for row in failed)


def test_bounds_lie_below_the_optimum_and_in_order(written):
    rows = rows_of(written[1] / "bounds.csv")
    ratios = np.array([float(row["ratio"]) for row in rows]).reshape(-1, 3)
    assert (ratios <= 1 + 1e-6).all() and (np.diff(ratios, axis=1) >= -1e-6).all()


def test_the_summary_names_command_and_methods(written):
    text = (written[1] / "summary.md").read_text(encoding="utf-8")
    assert "python -m benchmarks.optimality_gap" in text and "| open 2x6 | exact | 2 | 0 |" in text
    assert (written[1] / "optimality_gap.png").stat().st_size > 1000


def test_an_unknown_method_is_named():
    with pytest.raises(SettingsError, match="'serach-1ms'"):
        allocator("serach-1ms")
