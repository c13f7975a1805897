"""How far allocations are from the proven optimum, and bounds from it, in the time they take.

    python -m benchmarks.optimality_gap --scenes 100 --seed 0 --sizes 10x20,10x40,20x100 \
        --methods search-1ms,search-20ms,ortools-1s,exact,lp,greedy,pyvrp-1s --out out/optimality_gap

Writes ``optimality_gap.csv`` (a row a scene and method), ``bounds.csv`` (a row a scene and bound), ``summary.md`` and
``optimality_gap.png``. Scenes without obstacles are uniform in 20 x 20 x 5 m; those with obstacles are of the family
``forest``. ``bound`` is the travel of a proven optimum (``bound_kind`` says ``optimum``) or else what the exact method
proved in its time (``proven``); ``gap`` is relative to it and ``optimal`` says that the allocation is at a proven
optimum. A method that fails, or leaves a task out, keeps its row without a cost and counts as a failure.

Any planner can be judged: ``--methods`` also takes ``module:function`` with ``function(scene, travel, seed) -> Bundles``.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.allocation_cases import AllocationCase
from benchmarks.allocators import AllocationMethod, allocator
from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import FlockError, Scene, lower_bound
from flockopt.bundles import Bundles
from flockopt.bundles.exact.exact import OPTIMAL_GAP, solve_exact
from flockopt.travel import Travel

__all__ = ["main"]

COLUMNS = ("scene", "drones", "tasks", "method", "seconds", "cost", "bound", "bound_kind", "optimal", "gap")
BOUND_COLUMNS = ("scene", "drones", "tasks", "bound_kind", "seconds", "bound", "reference", "reference_kind", "ratio")
METHODS = "search-1ms,search-5ms,search-20ms,search-100ms,ortools-0.1s,ortools-1s,exact,lp,greedy"
BOUNDS = ("fast", "tight", "exact")

#: An allocation is at the optimum if it is longer by no more than this share.
AT_OPTIMUM = 1e-6


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if no method failed on any scene."""
    options = _parser().parse_args(argv)
    methods = {name: allocator(name) for name in options.methods.split(",")}
    cases = list(_cases(options))
    rows = CsvRows(options.out / "optimality_gap.csv", COLUMNS)
    bounds = CsvRows(options.out / "bounds.csv", BOUND_COLUMNS)
    groups: dict[str, list[AllocationCase]] = {}
    for number, case in enumerate(cases, start=1):
        scene, travel = case.make()
        if not groups:
            _warm_up(methods, scene, travel)
        groups.setdefault(case.group, []).append(case)
        _judge(case, scene, travel, methods, options.reference_s, rows, bounds)
        tell(f"{number}/{len(cases)} {case.name:<24}")
    tell("\n")
    rows.close()
    bounds.close()
    write_summary(options.out, _summary(groups, rows.records, bounds.records))
    _plot(groups, rows.records, options.out / "optimality_gap.png")
    return 0 if all(record["cost"] != "" for record in rows.records) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("optimality_gap", __doc__)
    parser.add_argument("--scenes", type=int, default=100, help="seeds for each size (default 100)")
    parser.add_argument("--sizes", default="10x20,10x40,20x100", help="drones x tasks, by commas")
    parser.add_argument("--methods", default=METHODS, help=f"by commas; also pyvrp-1s, module:function (default {METHODS})")
    parser.add_argument("--obstacles", choices=("with", "without", "both"), default="both", help="which scenes (default both)")
    parser.add_argument("--reference-s", type=float, default=60.0, help="time to prove each optimum, seconds (default 60)")
    return parser


def _cases(options: argparse.Namespace) -> Iterator[AllocationCase]:
    kinds = {"with": (True,), "without": (False,), "both": (False, True)}[options.obstacles]
    for has_obstacles in kinds:
        for size in options.sizes.split(","):
            drones, tasks = (int(part) for part in size.split("x"))
            yield from (AllocationCase(drones, tasks, options.seed + offset, has_obstacles) for offset in range(options.scenes))


def _warm_up(methods: dict[str, AllocationMethod], scene: Scene, travel: Travel) -> None:
    """Everything once, so that nothing is loaded or compiled while the clock runs; faults come up again later."""
    for method in methods.values():
        _timed(method, scene, travel, 0)
    for kind in BOUNDS:
        lower_bound(scene, travel, bound=kind)


def _timed(method: AllocationMethod, scene: Scene, travel: Travel, seed: int) -> tuple[float, Bundles | None]:
    """Seconds, and the bundles if they serve every task; None for a method that fails on the scene."""
    began = time.perf_counter()
    try:
        bundles = method(scene, travel, seed)
    except FlockError as fault:
        print(f"\n{fault}", file=sys.stderr)
        return time.perf_counter() - began, None
    seconds = time.perf_counter() - began
    complete = sorted(task for route in bundles for task in route) == list(range(scene.num_tasks))
    fits = all(
        sum(scene.tasks[j].demand for j in route) <= drone.capacity for route, drone in zip(bundles, scene.drones, strict=True)
    )
    return seconds, bundles if complete and fits and math.isfinite(travel.total(bundles.routes)) else None


def _judge(
    case: AllocationCase,
    scene: Scene,
    travel: Travel,
    methods: dict[str, AllocationMethod],
    reference_s: float,
    rows: CsvRows,
    bounds: CsvRows,
) -> None:
    """All methods and all bounds on one scene."""
    results = {name: _timed(method, scene, travel, case.seed) for name, method in methods.items()}
    found = [bundles for _, bundles in results.values() if bundles is not None]
    best = min(found, key=lambda bundles: travel.total(bundles.routes), default=None)
    reference = solve_exact(scene, travel, warm_start=best, time_limit_s=reference_s, seed=case.seed)
    is_proven = reference.status == "optimal"
    kind = "optimum" if is_proven else "proven"
    about = {"scene": case.name, "drones": case.drones, "tasks": case.tasks}
    for name, (seconds, bundles) in results.items():
        cost = math.nan if bundles is None else travel.total(bundles.routes)
        gap = max(cost / reference.proven - 1.0, 0.0) if reference.proven else 0.0
        told: Record = {"cost": "", "gap": ""} if bundles is None else {"cost": cost, "gap": gap if gap > OPTIMAL_GAP else 0.0}
        optimal = is_proven and bundles is not None and gap <= AT_OPTIMUM
        rows.add(
            {
                **about,
                "method": name,
                "seconds": seconds,
                "bound": reference.proven,
                "bound_kind": kind,
                "optimal": optimal,
                **told,
            }
        )
    for setting in BOUNDS:
        began = time.perf_counter()
        value = lower_bound(scene, travel, bound=setting).value
        seconds = time.perf_counter() - began
        ratio = value / reference.proven if reference.proven else 1.0
        told = {"bound": value, "reference": reference.proven, "reference_kind": kind, "ratio": ratio}
        bounds.add({**about, "bound_kind": setting, "seconds": seconds, **told})


def _of(group: list[AllocationCase], records: list[Record]) -> list[Record]:
    names = {case.name for case in group}
    return [record for record in records if record["scene"] in names]


def _numbers(records: list[Record], key: str) -> list[float]:
    return [float(record[key]) for record in records if record[key] != ""]


def _summary(groups: dict[str, list[AllocationCase]], rows: list[Record], bounds: list[Record]) -> str:
    gaps, ratios = [], []
    for name, group in groups.items():
        own = _of(group, rows)
        for method in dict.fromkeys(record["method"] for record in own):
            records = [record for record in own if record["method"] == method]
            percent = [100.0 * gap for gap in _numbers(records, "gap")]
            failed = len(records) - len(percent)
            proven = sum(record["bound_kind"] == "optimum" for record in records)
            shares = [f"{sum(bool(r['optimal']) for r in records)}/{len(records)}", f"{proven}/{len(records)}"]
            means = [float(np.mean(percent)), max(percent)] if percent else [math.nan, math.nan]
            gaps.append([name, method, len(records), failed, *means, *shares, *spread(_numbers(records, "seconds"))])
        for kind in BOUNDS:
            records = [record for record in _of(group, bounds) if record["bound_kind"] == kind]
            values = _numbers(records, "ratio")
            ratios.append([name, kind, float(np.mean(values)), min(values), 1e3 * spread(_numbers(records, "seconds"))[0]])
    gap_columns = [
        "scenes",
        "method",
        "runs",
        "failed",
        "mean gap %",
        "worst %",
        "at optimum",
        "optimum proven",
        "median s",
        "p95 s",
    ]
    note = "Gaps are to the proven optimum, or to the bound proven where it is not; failures are not in the means.\n\n"
    return "\n".join(
        [
            header("Optimality gap", "benchmarks.optimality_gap"),
            note + markdown_table(gap_columns, gaps),
            "Bound as a share of the optimum (or of the bound proven):\n",
            markdown_table(["scenes", "bound", "mean", "worst", "median ms"], ratios),
        ]
    )


def _plot(groups: dict[str, list[AllocationCase]], rows: list[Record], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(groups), 3.8), layout="constrained")
    panels = figure.subplots(1, len(groups), squeeze=False, sharey=True)[0]
    methods = dict.fromkeys(record["method"] for record in rows)
    for axes, (name, group) in zip(panels, groups.items(), strict=True):
        for number, method in enumerate(methods):
            records = [record for record in _of(group, rows) if record["method"] == method and record["gap"] != ""]
            if records:
                seconds, gap = np.median(_numbers(records, "seconds")), 100.0 * np.mean(_numbers(records, "gap"))
                axes.plot(seconds, gap, "osD^v"[number // 10 % 5], color=f"C{number % 10}", label=method)
        axes.set(title=name, xlabel="median seconds", xscale="log")
        axes.set_yscale("symlog", linthresh=0.01)
        axes.grid(alpha=0.3)
    handles = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside right center", frameon=False)
    panels[0].set_ylabel("mean gap, %")
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
