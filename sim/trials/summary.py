"""What a batch of flights amounts to: every measure of the paper, in Markdown and in a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flockopt.errors import require
from sim.trials.status import TrialStatus

__all__ = ["draw_summary", "flawless", "summary_text"]

Rows = Sequence[Mapping[str, Any]]

#: Measures of the paper and of the flight: words, column, factor, digits.
MEASURES = (
    ("planner coverage, %", "planner_coverage", 100.0, 2),
    ("execution completion, %", "execution_completion", 100.0, 2),
    ("planned route cost, m", "cost", 1.0, 2),
    ("gap to the proven bound, %", "gap", 100.0, 3),
    ("tasks per metre", "tasks_per_distance", 1.0, 4),
    ("bundle compactness", "bundle_compactness", 1.0, 3),
    ("mean insertion cost, m", "insertion_cost", 1.0, 2),
    ("allocation episode steps", "episode_steps", 1.0, 2),
    ("tasks per drone, standard deviation", "tasks_per_drone_std", 1.0, 3),
    ("mean tracking error, mm", "mean_tracking_error", 1000.0, 2),
    ("largest tracking error, mm", "max_tracking_error", 1000.0, 2),
    ("least clearance, m", "min_clearance", 1.0, 3),
    ("least separation, m", "min_separation", 1.0, 3),
    ("makespan, s", "makespan", 1.0, 2),
    ("energy of the rotors' shafts, J", "energy", 1.0, 1),
)

#: Counts of what happened in flight: words, column.
COUNTS = (
    ("events", "events"),
    ("tasks added", "tasks_added"),
    ("tasks removed", "tasks_removed"),
    ("drones lost", "drones_lost"),
    ("drones late", "drones_late"),
    ("gusts", "gusts"),
    ("replannings", "replans"),
    ("plans swapped in", "swaps"),
    ("of them certified by the judge anew", "swaps_certified"),
    ("answers refused, the old plan flown on", "refused"),
    ("tasks not served, with the reason", "unserved"),
    ("tasks neither served nor listed", "unexplained"),
)

#: Times, in milliseconds.
TIMES = (
    ("allocation or generation", ("allocate_s", "generate_s")),
    ("any-angle travel (the oracle)", ("travel_s",)),
    ("decoding and deconfliction (the repair)", ("decode_s", "deconflict_s")),
    ("whole plan, with bound and certificate", ("plan_s",)),
    ("flight", ("flight_s",)),
    ("longest replanning of a flight", ("replan_s",)),
)


def flawless(row: Mapping[str, Any]) -> bool:
    """Whether a flight was certified, served every task and touched nothing.

    After events also whether every plan that was swapped in was certified; tasks not served must be listed with a reason.
    """
    if row["status"] != TrialStatus.CERTIFIED or row["contacts"] != 0:
        return False
    if row.get("events"):
        return row["unexplained"] == 0 and row["swaps_certified"] == row["swaps"]
    return row["execution_completion"] == 1.0


def summary_text(heading: str, rows: Rows, timings: Rows) -> str:
    """The summary in Markdown: counts, measures, times, and every flight that was not flawless."""
    contacts = sum(row["contacts"] or 0 for row in rows)
    good = sum(flawless(row) for row in rows)
    lines = [heading, f"{good} of {len(rows)} flights certified, complete and without contact; {contacts} contacts in all.", ""]
    lines += ["| measure | mean | least | most |", "|---|---|---|---|"]
    for words, column, factor, digits in MEASURES:
        values = factor * np.array([row[column] for row in rows if row[column] is not None], dtype=np.float64)
        cells = [f"{value:.{digits}f}" for value in (values.mean(), values.min(), values.max())] if len(values) else ["n/a"] * 3
        lines.append(f"| {words} | " + " | ".join(cells) + " |")
    lines += _event_lines(rows)
    lines += ["", "| time, ms | median | 95th percentile |", "|---|---|---|"]
    for words, columns in TIMES:
        known = [row for row in timings if any(row.get(column) is not None for column in columns)]
        times = [sum(row[column] or 0.0 for column in columns) for row in known]
        cells = [f"{1000.0 * float(np.quantile(times, q)):.1f}" for q in (0.5, 0.95)] if times else ["n/a"] * 2
        lines.append(f"| {words} | " + " | ".join(cells) + " |")
    faults = [f"- {row['scene']}: {_fault(row)}" for row in rows if not flawless(row)]
    return "\n".join([*lines, "", *faults]).rstrip() + "\n"


def _event_lines(rows: Rows) -> list[str]:
    """What happened in flight and what came of it, if anything did."""
    if not any(row.get("events") for row in rows):
        return []
    lines = ["", "| in flight | number |", "|---|---|"]
    return lines + [f"| {words} | {sum(row[column] or 0 for row in rows)} |" for words, column in COUNTS]


def _fault(row: Mapping[str, Any]) -> str:
    status = TrialStatus(row["status"])
    if status is not TrialStatus.CERTIFIED:
        return f"{status} {row['failed']}".strip() + f"; {status.mend}"
    words = f"{row['execution_completion']:.0%} of the tasks served, {row['contacts']} contacts"
    if row.get("events"):
        uncertified = row["swaps"] - row["swaps_certified"]
        words += f", {row['unexplained']} tasks neither served nor listed, {uncertified} uncertified swaps"
    return words


def draw_summary(rows: Rows, path: Path) -> None:
    """Draw how the flights spread, a histogram a measure.

    Raises:
        MissingExtra: If matplotlib is not installed.
    """
    figure = require("matplotlib.figure", extra="show").Figure(figsize=(12, 8), layout="constrained")
    chosen = [measure for measure in MEASURES if measure[1] not in ("episode_steps", "makespan", "energy")]
    for axes, (words, column, factor, _) in zip(figure.subplots(3, 4).flat, chosen, strict=True):
        values = [factor * row[column] for row in rows if row[column] is not None]
        axes.hist(values, bins=min(20, max(4, len(values) // 4)), color="#4878a8", edgecolor="white")
        axes.set_title(words, fontsize=10)
        axes.tick_params(labelsize=8)
        axes.locator_params(axis="y", integer=True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{len(rows)} flights")
    figure.savefig(path, dpi=120)
