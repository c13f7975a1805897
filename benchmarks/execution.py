"""How well and how fast plans are flown: completion, tracking and real-time factor, in five families and two city blocks.

    python -m benchmarks.execution --scenes 20 --seed 0 --out out/execution

Writes ``execution.csv`` (a row a flight), ``summary.md`` and ``execution.png``. Real-time factors are seconds flown for each
processor second of one core; the plans they are measured on hold as many drones as ``--fleets`` says, and are flown twice:
with PyBullet asked while something is near, as flights are, and in every step.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.planning import CITIES, PlanningCase, warm_up
from benchmarks.report import CsvRows, benchmark_parser, header, markdown_table, tell, write_summary
from flockopt import FlockError, Scene, generate, plan
from flockopt.scene.families.layouts import FAMILIES
from sim.mission.execute import execute
from sim.physics.settings import FlightSettings
from sim.trials.trial import TRACKING_MARGIN_M

__all__ = ["main"]

COLUMNS = (
    "scene", "family", "seed", "drones", "tasks", "planner", "status", "failed", "execution_completion", "contacts",
    "mean_tracking_error", "max_tracking_error", "clearance", "min_clearance", "separation", "min_separation",
    "real_time_factor",
)  # fmt: skip

#: A flight is computed this often for its real-time factor; the fastest counts.
REPEATS = 5


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if every flight was certified, complete and without contact."""
    options = _parser().parse_args(argv)
    settings = FlightSettings(vehicle=options.vehicle, controller=options.controller)
    rows = CsvRows(options.out / "execution.csv", COLUMNS)
    warm_up(options.planner)
    cases = [
        PlanningCase(family, options.drones, options.tasks, options.seed + offset)
        for family in options.families
        for offset in range(1 if family in CITIES else options.scenes)
    ]
    for number, case in enumerate(cases, start=1):
        rows.add(_row(case, options, settings))
        tell(f"{number}/{len(cases)} {case.family:<10}")
    tell("\n")
    rows.close()
    factors = [(drones, *_fastest(drones, options, settings)) for drones in options.fleets]
    write_summary(options.out, _summary(rows.records, factors, settings))
    _plot(rows.records, options.out / "execution.png")
    return 0 if all(_is_flawless(record) for record in rows.records) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("execution", __doc__)
    parser.add_argument("--scenes", type=int, default=20, help="seeds for each family (default 20)")
    names = [*FAMILIES, *CITIES]
    parser.add_argument("--families", nargs="+", default=names, choices=names, help="what to fly")
    parser.add_argument("--drones", type=int, default=10, help="in each scene of a family (default 10)")
    parser.add_argument("--tasks", type=int, default=20, help="in each scene of a family (default 20)")
    parser.add_argument("--planner", default="classical", help="who plans (default classical)")
    parser.add_argument(
        "--tracking-margin", type=float, default=TRACKING_MARGIN_M, metavar="M",
        help=f"room that plans keep for tracking errors, metres (default {TRACKING_MARGIN_M:g})",
    )  # fmt: skip
    parser.add_argument("--vehicle", help="for all drones (default: by mass or radius)")
    parser.add_argument("--controller", default="geometric", help="geometric or mellinger (default geometric)")
    parser.add_argument("--fleets", type=int, nargs="*", default=[10, 50], help="sizes for real-time factors (default 10 50)")
    return parser


def _row(case: PlanningCase, options: argparse.Namespace, settings: FlightSettings) -> dict[str, Any]:
    scene = case.scene()
    record: dict[str, Any] = dict.fromkeys(COLUMNS) | {
        "scene": scene.sha256[:12], "family": case.family, "seed": case.seed, "drones": scene.num_drones,
        "tasks": scene.num_tasks, "planner": options.planner, "execution_completion": 0.0, "clearance": scene.clearance,
        "separation": scene.separation,
    }  # fmt: skip
    try:
        made = plan(scene, planner=options.planner, seed=case.seed, tracking_margin_m=options.tracking_margin)
        record["status"] = made.status
        flight = execute(scene, made, settings)
    except FlockError as fault:
        return record | {"status": record["status"] or "error", "failed": str(fault)}
    measures = flight.measures
    return record | {
        "execution_completion": measures.completion, "contacts": len(flight.touches),
        "mean_tracking_error": measures.mean_tracking_error, "max_tracking_error": measures.max_tracking_error,
        "min_clearance": measures.min_clearance, "min_separation": measures.min_separation,
        "real_time_factor": flight.real_time_factor,
    }  # fmt: skip


def _is_flawless(record: dict[str, Any]) -> bool:
    return record["status"] == "certified" and record["execution_completion"] == 1.0 and record["contacts"] == 0


def _fastest(drones: int, options: argparse.Namespace, settings: FlightSettings) -> tuple[float, float]:
    """The best real-time factors of a few runs of one flight: PyBullet asked while something is near, and in every step."""
    scene: Scene = generate("forest", drones=drones, tasks=2 * drones, seed=options.seed)
    made = plan(scene, planner=options.planner, seed=options.seed, tracking_margin_m=options.tracking_margin)
    ways = (settings, replace(settings, every_step=True))
    near, every = (max(execute(scene, made, way, force=True).real_time_factor for _ in range(REPEATS)) for way in ways)
    return near, every


def _summary(records: list[dict[str, Any]], factors: list[tuple[int, float, float]], settings: FlightSettings) -> str:
    table = []
    for family in dict.fromkeys(record["family"] for record in records):
        group = [record for record in records if record["family"] == family]
        flown = [record for record in group if record["contacts"] is not None]
        table.append([
            family, f"{sum(map(_is_flawless, group))}/{len(group)}",
            100.0 * float(np.mean([record["execution_completion"] for record in group])),
            sum(record["contacts"] for record in flown),
            1000.0 * _worst(flown, "mean_tracking_error", max), 1000.0 * _worst(flown, "max_tracking_error", max),
            _least_spare(flown, "clearance"), _least_spare(flown, "separation"),
        ])  # fmt: skip
    columns = ["scenes", "flawless", "completion %", "contacts", "worst mean error mm", "largest error mm"]
    columns += ["least clearance - asked m", "least distance - asked m"]
    faults = [
        f"- {record['family']} seed {record['seed']}: {record['status']} {record['failed'] or ''}"
        for record in records
        if not _is_flawless(record)
    ]
    rates = f"{settings.physics_hz:g} Hz physics, controllers at {settings.physics_hz * settings.num_inner:g} Hz"
    note = f"\n{rates}. Real-time factors: the fastest of {REPEATS} runs, seconds flown for each processor second.\n\n"
    text = [header("Execution", "benchmarks.execution"), markdown_table(columns, table), note]
    return "\n".join([*text, markdown_table(["drones", "real-time factor", "PyBullet in every step"], factors), *faults])


def _worst(records: list[dict[str, Any]], key: str, choose: Any) -> float:
    return choose((record[key] for record in records if record[key] is not None), default=float("nan"))


def _least_spare(records: list[dict[str, Any]], key: str) -> float:
    """What was flown of a clearance or separation beyond what the scene asks, at the least over all flights, metres."""
    spare = [record[f"min_{key}"] - record[key] for record in records if record[f"min_{key}"] is not None]
    return min(spare, default=float("nan"))


def _plot(records: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    flown = [record for record in records if record["contacts"] is not None]
    families = list(dict.fromkeys(record["family"] for record in flown))
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots()
    for key, offset, color in (("mean_tracking_error", -0.12, "#4878a8"), ("max_tracking_error", 0.12, "#d08030")):
        for place, family in enumerate(families):
            values = [1000.0 * record[key] for record in flown if record["family"] == family]
            label = key.replace("_", " ") if place == 0 else None
            axes.plot(np.full(len(values), place + offset), values, ".", color=color, alpha=0.6, label=label)
    axes.set_xticks(range(len(families)), families)
    axes.set_ylabel("mm")
    axes.set_ylim(bottom=0.0)
    if flown:
        axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
