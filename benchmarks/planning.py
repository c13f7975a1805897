"""How well and how fast scenes are planned: the five families and two city blocks, from file to certificate.

    python -m benchmarks.planning --scenes 20 --seed 0 --out out/planning

Writes ``planning.csv`` (a row a scene), ``summary.md`` and ``planning.png``. A scene that ends uncertified,
infeasible or in an error stays in the table and counts as a failure. The first plan of each process is a warm-up
and is not counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from joblib import Parallel, delayed

from benchmarks.report import (
    CsvRows,
    Record,
    benchmark_parser,
    header,
    markdown_table,
    peak_memory_gb,
    spread,
    tell,
    write_summary,
)
from flockopt import FlockError, Scene, generate, plan
from flockopt.scene.families.layouts import FAMILIES

__all__ = ["main"]

CITIES = ("rotterdam", "delft")
EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "scenes"
STAGES = ("travel", "allocate", "bound", "decode", "deconflict", "certify", "total")
COLUMNS = (
    "scene", "family", "seed", "drones", "tasks", "obstacles", "planner", "status", "failed", "certified",
    "cost", "bound", "bound_kind", "gap", "length", "makespan", "most_pieces", *(f"{stage}_s" for stage in STAGES),
)  # fmt: skip

#: A city block is planned this often; the others differ by seed already.
CITY_REPEATS = 5


@dataclass(frozen=True)
class PlanningCase:
    """One scene to plan: a family with a size and a seed, or a city block."""

    family: str
    drones: int
    tasks: int
    seed: int

    def scene(self) -> Scene:
        """The scene itself."""
        if self.family in CITIES:
            return Scene.load(EXAMPLES / f"{self.family}.json")
        return generate(self.family, drones=self.drones, tasks=self.tasks, seed=self.seed)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if every scene is certified."""
    options = _parser().parse_args(argv)
    cases = list(_cases(options))
    rows = CsvRows(options.out / "planning.csv", COLUMNS)
    work = Parallel(n_jobs=options.jobs, return_as="generator")(delayed(run)(case, options.planner) for case in cases)
    for number, record in enumerate(work, start=1):
        rows.add(record)
        tell(f"{number}/{len(cases)} {record['family']:<10} {record['status']:<12}")
    tell("\n")
    rows.close()
    write_summary(options.out, _summary(rows.records))
    _plot(rows.records, options.out / "planning.png")
    return 0 if all(record["certified"] for record in rows.records) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("planning", __doc__)
    parser.add_argument("--scenes", type=int, default=20, help="seeds for each family and size (default 20)")
    parser.add_argument(
        "--families", nargs="+", default=[*FAMILIES, *CITIES], choices=[*FAMILIES, *CITIES], help="what to plan"
    )
    parser.add_argument("--sizes", nargs="+", default=["10x20", "10x40"], help="drones x tasks (default 10x20 10x40)")
    parser.add_argument("--planner", default="classical", help="who plans (default classical)")
    parser.add_argument("--jobs", type=int, default=1, help="processes; timings are truest with 1 (default 1)")
    return parser


def _cases(options: argparse.Namespace) -> Iterator[PlanningCase]:
    for family in options.families:
        if family in CITIES:
            yield from (
                PlanningCase(family, 0, 0, options.seed + repeat) for repeat in range(min(CITY_REPEATS, options.scenes))
            )
            continue
        for size in options.sizes:
            drones, tasks = (int(part) for part in size.split("x"))
            yield from (PlanningCase(family, drones, tasks, options.seed + offset) for offset in range(options.scenes))


@cache
def warm_up(planner: str) -> None:
    """Plan something once in this process, so that nothing is loaded or compiled while the clock runs."""
    plan(generate("rooms", drones=3, tasks=6, seed=0), planner=planner)


def run(case: PlanningCase, planner: str) -> Record:
    """Plan one scene and describe the outcome as a row."""
    warm_up(planner)
    scene = case.scene()
    record: Record = {
        "scene": scene.sha256[:12], "family": case.family, "seed": case.seed, "drones": scene.num_drones,
        "tasks": scene.num_tasks, "obstacles": len(scene.obstacles), "planner": planner,
    }  # fmt: skip
    try:
        result = plan(scene, planner=planner, seed=case.seed)
    except FlockError as fault:
        return record | {"status": "error", "failed": str(fault), "certified": False}
    failed = [] if result.certificate is None else [clause.name for clause in result.certificate.clauses if not clause.holds]
    kind = None if result.certificate is None or result.certificate.bound is None else result.certificate.bound.kind
    return record | {
        "status": result.status, "failed": " ".join(failed) or result.reason, "certified": result.status == "certified",
        "cost": result.cost.travel, "bound": result.cost.lower_bound, "bound_kind": kind, "gap": result.cost.gap,
        "length": result.cost.length, "makespan": result.cost.makespan,
        "most_pieces": max((flight.curve.num_pieces for flight in result.flights.values()), default=0),
        **{f"{stage}_s": result.timing.get(stage, 0.0) for stage in STAGES},
    }  # fmt: skip


def _groups(records: list[Record]) -> dict[tuple[object, str], list[Record]]:
    groups: dict[tuple[object, str], list[Record]] = {}
    for record in records:
        groups.setdefault((record["family"], f"{record['drones']}x{record['tasks']}"), []).append(record)
    return groups


def _summary(records: list[Record]) -> str:
    table = []
    for (family, size), group in _groups(records).items():
        done = [record for record in group if record["certified"]]
        share = f"{len(done)}/{len(group)}"
        means = [_mean(done, key) for key in ("cost", "bound", "gap", "makespan")]
        median, worst = spread([record["total_s"] * 1e3 for record in done])
        stages = [spread([record[f"{stage}_s"] * 1e3 for record in done])[0] for stage in STAGES[:-1]]
        pieces = max((record["most_pieces"] for record in done), default=0)
        table.append([family, size, share, *means, pieces, *stages, median, worst])
    columns = ["scenes", "size", "certified", "cost m", "bound m", "gap", "makespan s", "most pieces"]
    columns += [f"{stage} ms" for stage in STAGES[:-1]] + ["plan ms", "p95 ms"]
    certified = sum(bool(record["certified"]) for record in records)
    failures = [
        "- {family} {drones}x{tasks} seed {seed}: {status} {failed}".format_map(record)
        for record in records
        if not record["certified"]
    ]
    closing = f"\n{certified} of {len(records)} certified. Peak memory {peak_memory_gb():.2f} GB.\n"
    note = "Costs, bounds, gaps and makespans are means over certified scenes; times are medians.\n\n"
    text = [header("Planning", "benchmarks.planning"), note + markdown_table(columns, table) + closing, *failures]
    return "\n".join(text)


def _mean(records: list[Record], key: str) -> float:
    values = [float(record[key]) for record in records if record[key] is not None]
    return sum(values) / len(values) if values else float("nan")


def _plot(records: list[Record], path: Path) -> None:
    from matplotlib.figure import Figure

    groups = {key: group for key, group in _groups(records).items() if any(record["certified"] for record in group)}
    figure = Figure(figsize=(9, 0.4 * len(groups) + 1.2), layout="constrained")
    axes = figure.subplots()
    left = [0.0] * len(groups)
    names = [f"{family} {size}" for family, size in groups]
    for stage in STAGES[:-1]:
        width = [spread([r[f"{stage}_s"] * 1e3 for r in group if r["certified"]])[0] for group in groups.values()]
        axes.barh(names, width, left=left, label=stage)
        left = [a + b for a, b in zip(left, width, strict=True)]
    axes.set_xlabel("median milliseconds by stage")
    axes.invert_yaxis()
    axes.legend(frameon=False, ncols=3)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
