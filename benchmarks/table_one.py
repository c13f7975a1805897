"""Table I of the paper from rows of flights: means with confidence, reductions, families, and a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.report import Record, header, markdown_table
from flockopt.records.arrays import FloatArray

__all__ = ["draw", "summary"]

BASELINE = "magnnet-bundling"

#: What stands where a measure says nothing.
NOTHING = "-"

#: Measures: words, column, factor, digits, whether they say anything of a plan that leaves tasks out.
MEASURES = (
    ("completion in PyBullet, %", "execution_completion", 100.0, 1, True),
    ("route cost, m", "cost", 1.0, 2, True),
    ("the same on a 26-connected voxel grid, m", "cost_voxel26", 1.0, 2, True),
    ("the same on a 6-connected voxel grid, m", "cost_voxel6", 1.0, 2, True),
    ("bundle compactness", "bundle_compactness", 1.0, 3, False),
    ("mean insertion cost, m", "insertion_cost", 1.0, 2, False),
    ("tasks per metre", "tasks_per_distance", 1.0, 4, False),
    ("episode steps", "episode_steps", 1.0, 2, True),
    ("tasks per drone, std", "tasks_per_drone_std", 1.0, 3, True),
    ("gap to the proven optimum, %", "gap_to_optimum", 100.0, 2, False),
)

#: The paper's Table I: baseline, + bundling, ours.
PAPER: dict[str, tuple[str, str, str]] = {
    "execution_completion": ("50", "100", "100"),
    "cost": ("413.10", "338.80", "310.22"),
    "bundle_compactness": (NOTHING, "0.47", "0.45"),
    "insertion_cost": (NOTHING, "12.90", "10.84"),
    "tasks_per_distance": (NOTHING, "0.06", "0.07"),
    "episode_steps": ("100", "4.20", "3.78"),
    "tasks_per_drone_std": ("0.00", "0.97", "1.01"),
}

#: What Table I says of the teacher against MAGNNET + bundling, per cent less.
PAPER_REDUCTIONS = {"cost": 8.4, "insertion_cost": 16.0, "episode_steps": 10.0}

#: Scenes drawn anew, with replacement, for a confidence interval.
RESAMPLES = 2000


def summary(records: Sequence[Record]) -> str:
    """The tables in Markdown, and every flight but MAGNNET's that was not certified and complete."""
    methods = list(dict.fromkeys(record["method"] for record in records))
    by_method = {method: [record for record in records if record["method"] == method] for method in methods}
    proven = sum(bool(record.get("is_optimal")) for record in by_method.get("exact", []))
    head = f"{len(by_method[methods[0]])} scenes, mean ± 95 % confidence; the paper's figures in brackets."
    if "exact" in by_method:
        head += f" Optima proven: {proven} of {len(by_method['exact'])}."
    parts = [header("Teacher ablation", "benchmarks.teacher_ablation"), head + "\n", _table_one(by_method)]
    if BASELINE in by_method:
        parts += [f"Against {BASELINE}, per cent less, with 95 % confidence (scenes resampled):\n", _reductions(by_method)]
    parts += ["Route cost, m, and gap to the proven optimum, %, by family:\n", _by_family(by_method)]
    faults = [
        f"- {record['method']} {record['scene']}: {record['status']} {record['failed']}"
        for record in records
        if record["method"] != "magnnet" and (record["status"] != "certified" or record["execution_completion"] != 1.0)
    ]
    return "\n".join([*parts, *faults])


def _table_one(by_method: Mapping[str, Sequence[Record]]) -> str:
    table = []
    for words, column, factor, digits, is_partial in MEASURES:
        cells = [words]
        for method, records in by_method.items():
            in_paper = dict(zip(("magnnet", BASELINE, "teacher"), PAPER.get(column, ()), strict=False)).get(method)
            values = factor * _values(records, column) if is_partial or method != "magnnet" else np.empty(0)
            cells.append(_with_confidence(values, digits) + (f" ({in_paper})" if in_paper else ""))
        table.append(cells)
    return markdown_table(["measure", *by_method], table)


def _values(records: Sequence[Record], column: str) -> FloatArray:
    return np.array([record[column] for record in records if record.get(column) is not None], dtype=np.float64)


def _with_confidence(values: FloatArray, digits: int) -> str:
    if not len(values):
        return NOTHING
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{values.mean():.{digits}f} ± {half:.{digits}f}"


def _reductions(by_method: Mapping[str, Sequence[Record]]) -> str:
    """How much less than the baseline each method costs, of the means over the scenes that both served."""
    table = []
    for words, column, *_ in MEASURES:
        if column not in PAPER_REDUCTIONS:
            continue
        cells = [words, f"{PAPER_REDUCTIONS[column]:g}"]
        for method in by_method:
            if method not in (BASELINE, "magnnet"):
                cells.append(_reduction(by_method[method], by_method[BASELINE], column))
        table.append(cells)
    others = [method for method in by_method if method not in (BASELINE, "magnnet")]
    return markdown_table(["measure", "paper's teacher", *others], table)


def _reduction(records: Sequence[Record], baseline: Sequence[Record], column: str) -> str:
    own, base = ({record["scene"]: record.get(column) for record in rows} for rows in (records, baseline))
    pairs = np.array([(own[scene], base[scene]) for scene in own if own[scene] is not None and base.get(scene) is not None])
    if not len(pairs):
        return NOTHING
    draws = np.random.default_rng(0).integers(len(pairs), size=(RESAMPLES, len(pairs)))
    means = pairs[draws].mean(axis=1)  # (RESAMPLES, 2)
    low, high = np.quantile(100.0 * (1.0 - means[:, 0] / means[:, 1]), (0.025, 0.975))
    return f"{100.0 * (1.0 - pairs[:, 0].mean() / pairs[:, 1].mean()):.1f} ({low:.1f} to {high:.1f})"


def _by_family(by_method: Mapping[str, Sequence[Record]]) -> str:
    table = []
    for family in dict.fromkeys(record["family"] for records in by_method.values() for record in records):
        cells = [family]
        for records in by_method.values():
            own = [record for record in records if record["family"] == family]
            cost, gap = _values(own, "cost"), _values(own, "gap_to_optimum")
            words = f"{cost.mean():.1f}" if len(cost) else NOTHING
            cells.append(words + (f", {100.0 * gap.mean():.1f} %" if len(gap) else ""))
        table.append(cells)
    return markdown_table(["family", *by_method], table)


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw route cost, insertion cost and gap by method, with their confidence."""
    from matplotlib.figure import Figure

    methods = [name for name in dict.fromkeys(record["method"] for record in records) if name != "magnnet"]
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    chosen = [measure for measure in MEASURES if measure[1] in ("cost", "insertion_cost", "gap_to_optimum")]
    for axes, (words, column, factor, *_) in zip(figure.subplots(1, 3), chosen, strict=True):
        for place, method in enumerate(methods):
            values = factor * _values([record for record in records if record["method"] == method], column)
            if len(values):
                half = 1.96 * values.std() / np.sqrt(len(values))
                axes.bar(
                    place, values.mean(), yerr=half, color="#d08030" if method.startswith("teacher") else "#4878a8", capsize=3
                )
        axes.set_xticks(range(len(methods)), methods, rotation=35, ha="right", fontsize=8)
        axes.set_title(words, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)
