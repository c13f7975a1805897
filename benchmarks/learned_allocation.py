"""What the learned allocators are worth before anything flies: against greedy, optimal assignments and proven optima.

    python -m benchmarks.learned_allocation --scenes 100 --seed 0 --out out/learned_allocation

Scenes of 10 drones and 20 tasks are dealt to the families in turn; training used seeds from 900,000 up. ``--teacher`` and
``--magnnet`` name other weights, such as those of another training's seed. Writes ``learned_allocation.csv`` (a row a
scene and method) and ``summary.md``. `benchmarks.teacher_ablation` flies the same methods.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.allocators import nearest_task
from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, write_summary
from flockopt import Scene, compute_travel, generate
from flockopt.bundles.bundles import insertion_cost
from flockopt.bundles.exact.exact import solve_exact
from flockopt.cli.status import run_command
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel import Travel
from learned.teacher.allocators import Allocation, load_allocator
from learned.teacher.refinement import refine
from learned.teacher.training.validation import optimal_one_task_cost

__all__ = ["main"]

COLUMNS = ("scene", "method", "cost", "reference", "insertion", "steps")

#: Seconds to prove an optimum.
PROOF_S = 60.0

#: Half the width of a 95 % confidence interval, in standard errors.
CONFIDENCE = 1.96


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 2 on bad input."""
    parser = benchmark_parser("learned_allocation", __doc__)
    parser.add_argument("--scenes", type=int, default=100, help="how many (default 100)")
    parser.add_argument("--teacher", type=Path, help="the teacher's weights (default those of the package)")
    parser.add_argument("--magnnet", type=Path, help="MAGNNET's weights (default those of the package)")
    options = parser.parse_args(argv)
    return run_command("benchmarks.learned_allocation", lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    names = [(FAMILIES_IN_TURN[k % len(FAMILIES_IN_TURN)], options.seed + k // len(FAMILIES)) for k in range(options.scenes)]
    scenes = [generate(family, drones=10, tasks=20, seed=seed) for family, seed in names]
    travels = [compute_travel(scene) for scene in scenes]
    weights = {"magnnet": options.magnnet, "magnnet-bundling": options.magnnet, "teacher": options.teacher}
    found = {method: load_allocator(method, path).bundles(scenes, travels) for method, path in weights.items()}
    for method in ("magnnet-bundling", "teacher"):
        routes = refine(scenes, travels, [allocation.routes for allocation in found[method]])
        pairs = zip(found[method], routes, strict=True)
        found[f"{method}, refined"] = [dataclasses.replace(allocation, routes=better) for allocation, better in pairs]
    found["nearest task"] = _greedy(scenes, travels)
    found["nearest task, one each"] = _greedy([_with_one_each(scene) for scene in scenes], travels)
    optima = [solve_exact(scene, travel, time_limit_s=PROOF_S).proven for scene, travel in zip(scenes, travels, strict=True)]
    assignments = [optimal_one_task_cost(travel.start_task) for travel in travels]
    rows = CsvRows(options.out / "learned_allocation.csv", COLUMNS)
    for method, allocations in found.items():
        references = assignments if method in ONE_TASK else optima
        for scene, travel, allocation, reference in zip(scenes, travels, allocations, references, strict=True):
            cost, insertion = travel.total(allocation.routes), insertion_cost(travel, allocation.routes)
            told = (scene.name, method, cost, reference, insertion, allocation.steps)
            rows.add(dict(zip(COLUMNS, told, strict=True)))
    rows.close()
    write_summary(options.out, _summary(rows.records))
    return 0


FAMILIES_IN_TURN = tuple(FAMILIES)

#: Methods that give each drone one task; they are compared with the optimal one-task assignment.
ONE_TASK = ("magnnet", "nearest task, one each")


def _greedy(scenes: Sequence[Scene], travels: Sequence[Travel]) -> list[Allocation]:
    found = [nearest_task(scene, travel, 0).routes for scene, travel in zip(scenes, travels, strict=True)]
    return [Allocation(routes, sum(map(len, routes)), 0.0) for routes in found]


def _with_one_each(scene: Scene) -> Scene:
    return scene.replace(drones=tuple(dataclasses.replace(drone, capacity=1) for drone in scene.drones))


def _summary(records: list[Record]) -> str:
    columns = ["method", "scenes", "cost, m", "above the reference, %", "insertion cost, m", "steps"]
    table = []
    for method in dict.fromkeys(record["method"] for record in records):
        cost, reference, insertion, steps = (
            np.array([record[name] for record in records if record["method"] == method], dtype=float) for name in COLUMNS[2:]
        )
        above = 100.0 * (cost.sum() / reference.sum() - 1.0)
        table.append(
            [method, len(cost), _with_confidence(cost), f"{above:.2f}", _with_confidence(insertion), float(steps.mean())]
        )
    note = (
        f"Mean and 95 % confidence. The reference of {' and '.join(ONE_TASK)} is the optimal assignment of one task a drone; "
        "that of the others is the proven optimum, or the bound proven where it is not.\n\n"
    )
    return header("Learned allocation", "benchmarks.learned_allocation") + "\n" + note + markdown_table(columns, table)


def _with_confidence(values: np.ndarray) -> str:
    half = CONFIDENCE * float(values.std(ddof=1)) / len(values) ** 0.5 if len(values) > 1 else float("nan")
    return f"{values.mean():.2f} ± {half:.2f}"


if __name__ == "__main__":
    sys.exit(main())
