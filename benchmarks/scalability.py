"""How planning time and route length grow with the tasks: the student, the classical engine and voxel pipelines.

    python -m benchmarks.scalability --scenes 100 --seed 0 --out out/scalability

Ten drones, 20, 30 and 40 tasks, the same scenes for all in one process. The clock of each pipeline covers all from a scene
in memory to ways that are clear, one polyline (V, 3) a drone; for the student and the classical engine a second reading
goes on to decoded flights.

- ``learned``: straight distances, head, 100 iterations of search, denoiser for the drones with a blocked leg, choice among
  tries, pulling taut; where a leg stays blocked, the any-angle paths of the routes, which count. torch computes the network;
  in ``learned, openvino`` OpenVINO does, in float32. Loading weights and compiling do not count: they happen once a process.
- ``learned, batches of 16``: ``learned`` of 16 scenes at a time, of one size; times are a scene's share.
- ``classical``: any-angle travel, search, paths. ``hybrid``: any-angle travel, both searches, the student's ways.
- ``voxel6``, ``voxel26``: Dijkstra's costs on a voxel grid, MAGNNET + bundling by them, A* legs: the paper's baseline.
  ``voxel6-greedy``: the same with bundles of a greedy construction, which takes next to no time.

Writes ``scalability.csv`` (a row a scene and pipeline), ``summary.md`` and ``scalability.png``. Times are the process's own
CPU time on one thread, which other load on the machine stretches less than the clock on the wall; ``wall_s`` is that one.
Ratios are taken scene by scene, and medians of them reported. Every flight is judged after the clock has stopped. The first
scenes of each size are a warm-up, which compiles all there is to compile, and not counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from benchmarks.way_finders import NAMES, UNSEEN, Clock, WayFinder, WaysFound, way_finders
from flockopt import Scene, generate, refine_bundles
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.bundles.exact.exact import solve_exact
from flockopt.flights.decode import decode
from flockopt.planning.finish import GivenFlights, finish
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel

__all__ = ["main"]

#: Seconds for the proven optimum of a scene; where they do not suffice, the scene counts for the other columns only.
EXACT_S = 2.0

#: Scenes of each size that are not counted.
WARM_UP = 3

#: What ratios are taken to.
VOXEL = ("voxel6", "voxel26", "voxel6-greedy")

COLUMNS = (
    "scene", "tasks", "seed", "pipeline", "ways_s", "wall_s", "flights_s", "length", "any_angle", "best", "optimal",
    "clear_before", "certified",
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    pipelines = way_finders(options.family)
    rows = CsvRows(options.out / "scalability.csv", COLUMNS)
    for tasks in options.tasks:
        for number in range(-WARM_UP, options.scenes):
            scene = generate(options.family, drones=10, tasks=tasks, seed=UNSEEN + options.seed + number)
            records = list(_records(scene, options.seed + max(number, 0), number < 0, pipelines))
            for record in records if number >= 0 else ():
                rows.add(record)
            tell(f"{tasks} tasks: {number + 1}/{options.scenes}")
    tell("\n")
    rows.close()
    write_summary(options.out, _summary(rows.records, options.tasks))
    _plot(rows.records, options.tasks, options.out / "scalability.png")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("scalability", __doc__)
    parser.add_argument("--scenes", type=int, default=100, help="for each number of tasks (default 100)")
    parser.add_argument("--tasks", type=int, nargs="+", default=[20, 30, 40], help="numbers of tasks (default 20 30 40)")
    parser.add_argument("--family", choices=FAMILIES, default="forest", help="of the scenes (default forest)")
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    return parser


def _records(scene: Scene, seed: int, warm_up: bool, pipelines: dict[str, WayFinder]) -> Iterator[Record]:
    """A row for each pipeline."""
    travel = compute_travel(scene)
    best = refine_bundles(scene, travel=travel, iterations=20_000)
    exact = None if warm_up else solve_exact(scene, travel, warm_start=best, time_limit_s=EXACT_S)
    optimal = exact is not None and exact.bundles.status == "optimal"
    for name, pipeline in pipelines.items():
        outcome = pipeline(scene, seed)
        flights_s, certified = _judged(scene, outcome, travel)
        yield {
            "scene": scene.sha256[:12], "tasks": scene.num_tasks, "seed": seed, "pipeline": name, "ways_s": outcome.ways_s,
            "wall_s": outcome.wall_s, "flights_s": flights_s, "length": outcome.length,
            "any_angle": travel.total(outcome.bundles.routes),
            "best": travel.total(exact.bundles.routes if exact is not None else best.routes), "optimal": optimal,
            "clear_before": outcome.clear_before, "certified": certified,
        }  # fmt: skip


def _judged(scene: Scene, outcome: WaysFound, travel: Travel) -> tuple[float, bool]:
    """CPU seconds to decoded flights, and whether the plan is certified once flights are kept apart; NaN if not decoded."""
    if outcome.travel is None:
        return float("nan"), False
    clock = Clock()
    flights = decode(scene, outcome.bundles, outcome.samples, travel=outcome.travel)
    flights_s = outcome.ways_s + clock.read()[0]
    proof = lower_bound(scene, travel, bound="fast")
    made = finish(scene, travel, outcome.bundles, GivenFlights(flights), planner="scalability", proof=proof)
    return flights_s, made.status == Status.CERTIFIED


def _column(records: list[Record], pipeline: str, tasks: int, key: str) -> FloatArray:
    """(S,): one column of one pipeline, by scene."""
    chosen = [row[key] for row in records if (row["pipeline"], row["tasks"]) == (pipeline, tasks)]
    return np.array(chosen, dtype=np.float64)


def _summary(records: list[Record], sizes: Sequence[int]) -> str:
    table = []
    for tasks in sizes:
        voxel = {name: _column(records, name, tasks, "ways_s") for name in VOXEL}
        far = {name: _column(records, name, tasks, "length") for name in VOXEL}
        optimal = _column(records, "classical", tasks, "optimal") > 0
        for name in _names(records):
            seconds, length = (_column(records, name, tasks, key) for key in ("ways_s", "length"))
            flights = spread(1e3 * _column(records, name, tasks, "flights_s"))
            faster = [float(np.median(other / seconds)) for other in voxel.values()]
            shorter = [100.0 * (1.0 - float(np.mean(length / other))) for other in far.values()]
            over_ways = 100.0 * float(np.mean(length / _column(records, name, tasks, "any_angle") - 1.0))
            over_best = (length / _column(records, name, tasks, "best") - 1.0)[optimal]
            wall = spread(1e3 * _column(records, name, tasks, "wall_s"))
            table.append([
                tasks, name, *spread(1e3 * seconds), *wall, *flights, *faster, float(length.mean()), *shorter, over_ways,
                100.0 * float(over_best.mean()) if optimal.any() else float("nan"),
                100.0 * float(_column(records, name, tasks, "clear_before").mean()),
                100.0 * float(_column(records, name, tasks, "certified").mean()),
            ])  # fmt: skip
    columns = [
        "tasks", "pipeline", "ways CPU ms", "p95", "wall ms", "p95", "flights CPU ms", "p95", "x faster than voxel6",
        "than voxel26", "than voxel6-greedy", "length m", "% shorter than voxel6", "than voxel26", "than voxel6-greedy",
        "% over any-angle, same bundles", "% over the optimum", "clear before %",
        "certified %",
    ]  # fmt: skip
    growth = [f"{name} {_growth(records, name, sizes):.2f}" for name in _names(records)]
    proven = sum(bool(row["optimal"]) for row in records if row["pipeline"] == "classical")
    notes = f"\nGrowth of the median CPU time to ways from {sizes[0]} to {sizes[-1]} tasks: {'; '.join(growth)}.\n"
    notes += f"Optima proven for {proven} scenes; voxel pipelines are not decoded, so not judged.\n"
    return "\n".join([header("Scalability", "benchmarks.scalability"), markdown_table(columns, table), notes])


def _names(records: list[Record]) -> list[str]:
    """The pipelines that were run, in order."""
    return [name for name in NAMES if any(row["pipeline"] == name for row in records)]


def _growth(records: list[Record], name: str, sizes: Sequence[int]) -> float:
    """How many times the median time to ways of the most tasks is that of the fewest."""
    first, last = (np.median(_column(records, name, tasks, "ways_s")) for tasks in (sizes[0], sizes[-1]))
    return float(last / first)


def _plot(records: list[Record], sizes: Sequence[int], path: Path) -> None:
    """Median milliseconds to ways, with bands from the 5th to the 95th percentile."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name in _names(records):
        columns = [1e3 * _column(records, name, tasks, "ways_s") for tasks in sizes]
        low, middle, high = np.array([np.quantile(column, (0.05, 0.5, 0.95)) for column in columns]).T
        (line,) = axes.plot(sizes, middle, marker="o", label=name)
        axes.fill_between(sizes, low, high, alpha=0.2, color=line.get_color())
    axes.set_xlabel("tasks")
    axes.set_ylabel("CPU milliseconds from scene to ways")
    axes.set_yscale("log")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
