"""How planning time and route length grow with the tasks: the student, the classical engine and voxel pipelines.

    python -m benchmarks.scalability --scenes 100 --seed 0 --out out/scalability

Ten drones, 20, 30 and 40 tasks, the same scenes for all in one process. Each pipeline is timed from a scene to ways that
are clear, one polyline a drone, and the student and the classical engine on to decoded flights:

- ``learned``: head, refinement by straight distances, denoiser; shortest paths are searched for only where a way comes out
  blocked, which counts. ``classical``: any-angle travel, search. ``hybrid``: any-angle travel, both searches, denoiser.
- ``voxel6``, ``voxel26``: Dijkstra's costs on a voxel grid, bundles by them, A* legs, as in the paper's baseline. The
  bundles are those of the greedy construction, or of a learned policy with ``--voxel-bundles magnnet-bundling``.

Writes ``scalability.csv`` (a row a scene and pipeline), ``summary.md`` and ``scalability.png``. Ratios are taken scene by
scene. Every flight is judged after the clock has stopped. The first scene of each size is a warm-up and not counted.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from benchmarks.report import Rows, header, markdown_table, spread, write_summary
from flockopt import Scene, generate, refine_bundles
from flockopt.allocate.bounds import lower_bound
from flockopt.allocate.exact import solve_exact
from flockopt.bundles import Bundles
from flockopt.certify import certify
from flockopt.families import FAMILIES
from flockopt.geometry import FloatArray
from flockopt.plan import Request, classical, draft_plan, plan_cost
from flockopt.trajectory.decode import decode
from flockopt.trajectory.deconflict import deconflict
from flockopt.trajectory.waypoints import waypoints_from_samples
from flockopt.travel import Travel, compute_travel, straight_travel
from learned.planner import magnnet_bundling
from learned.rollout import route_legs
from learned.student.inference import Drawing
from learned.student.model import Student
from learned.student.planner import drawn_plan, searched_plan, shipped_student
from learned.voxels import VoxelSettings, voxel_oracle

__all__ = ["main"]

#: Added to the seeds, so that no scene is one of the demonstrations, whose seeds start at 0.
UNSEEN = 60_000_000

#: Seconds for the proven optimum of a scene; where they do not suffice, the scene counts for the other columns only.
EXACT_S = 5.0

GREEDY = "greedy"
BACKENDS = ("torch", "openvino-f32", "openvino-bf16")
NAMES = ("learned", "hybrid", "classical", "voxel6", "voxel26")

COLUMNS = (
    "scene", "tasks", "seed", "pipeline", "ways_s", "flights_s", "length", "any_angle", "best", "optimal", "clear_before",
    "certified",
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a pipeline made of a scene.

    Attributes:
        bundles: Which drone visits what.
        length: Metres, of the ways.
        ways_s: Seconds to the ways.
        travel: To decode with; None for pipelines that are not decoded.
        samples: (N, T, 3) m control points, where the ways come from a student.
        clear_before: Whether no way had to be mended.
    """

    bundles: Bundles
    length: float
    ways_s: float
    travel: Travel | None = None
    samples: FloatArray | None = None
    clear_before: bool = True


def by_learning(student: Student, scene: Scene, seed: int) -> Outcome:
    """The student without any search for paths, unless a way comes out blocked."""
    began = perf_counter()
    travel = straight_travel(scene)
    bundles, drawing, _ = drawn_plan(student, Request(scene, travel, None, seed))
    if drawing is not None and not drawing.clear.all():
        travel = compute_travel(scene, routes=bundles.routes)
    return _mended(scene, bundles, drawing, travel, began)


def by_both(student: Student, scene: Scene, seed: int) -> Outcome:
    """The hybrid: searches over any-angle travel, and the student's ways."""
    began = perf_counter()
    travel = compute_travel(scene)
    bundles, drawing, _ = searched_plan(student, Request(scene, travel, None, seed))
    return _mended(scene, bundles, drawing, travel, began)


def _mended(scene: Scene, bundles: Bundles, drawing: Drawing | None, travel: Travel, began: float) -> Outcome:
    """The drawn ways, with shortest paths where they are blocked."""
    if drawing is None:
        raise RuntimeError(f"{scene.name} has more legs a drone than the student has samples")
    ways = [waypoints_from_samples(scene, travel, drone, route, drawing.samples[drone]) for drone, route in enumerate(bundles)]
    seconds, length = perf_counter() - began, sum(_length(way.points) for way in ways)
    return Outcome(bundles, length, seconds, travel, drawing.samples, bool(drawing.clear.all()))


def classically(scene: Scene, seed: int) -> Outcome:
    """Any-angle travel and search."""
    began = perf_counter()
    travel = compute_travel(scene)
    bundles = classical(Request(scene, travel, None, seed)).bundles
    for drone, route in enumerate(bundles):
        route_legs(scene, drone, route, travel.path)
    return Outcome(bundles, travel.total(bundles.routes), perf_counter() - began, travel)


def on_voxels(connectivity: int, bundling: str, scene: Scene, seed: int) -> Outcome:
    """Dijkstra's costs, bundles, A* legs."""
    began = perf_counter()
    if bundling != GREEDY:
        proposal = magnnet_bundling(Request(scene, straight_travel(scene), None, seed, paths=f"voxel{connectivity}"))
        ways = list(np.asarray(proposal.samples))
        return Outcome(proposal.bundles, sum(map(_length, ways)), perf_counter() - began)
    oracle = voxel_oracle(scene, VoxelSettings(connectivity))
    bundles = refine_bundles(scene, travel=oracle.travel, iterations=0, seed=seed)
    ways = [leg for drone, route in enumerate(bundles) for leg in route_legs(scene, drone, route, oracle.leg)]
    return Outcome(bundles, sum(map(_length, ways)), perf_counter() - began)


def _length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _pipelines(backend: str, bundling: str) -> dict[str, Callable[[Scene, int], Outcome]]:
    """The pipelines by name."""
    student = shipped_student()
    if backend != "torch":
        from learned.student.openvino_backend import OpenVinoStudent

        student = OpenVinoStudent(student, backend.removeprefix("openvino-"))  # type: ignore[assignment]
    return {
        "learned": partial(by_learning, student),
        "hybrid": partial(by_both, student),
        "classical": classically,
        "voxel6": partial(on_voxels, 6, bundling),
        "voxel26": partial(on_voxels, 26, bundling),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    pipelines = _pipelines(options.backend, options.voxel_bundles)
    rows = Rows(options.out / "scalability.csv", COLUMNS)
    for tasks in options.tasks:
        for number in range(-1, options.scenes):
            scene = generate(options.family, drones=10, tasks=tasks, seed=UNSEEN + options.seed + number)
            records = list(_records(scene, options.seed + max(number, 0), number < 0, pipelines))
            for record in records if number >= 0 else ():
                rows.add(record)
            print(f"\r{tasks} tasks: {number + 1}/{options.scenes}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    rows.close()
    write_summary(options.out, _summary(rows.records, options.tasks))
    _plot(rows.records, options.tasks, options.out / "scalability.png")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scalability", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenes", type=int, default=100, help="for each number of tasks (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="the first seed (default 0)")
    parser.add_argument("--tasks", type=int, nargs="+", default=[20, 30, 40], help="numbers of tasks (default 20 30 40)")
    parser.add_argument("--family", choices=FAMILIES, default="forest", help="of the scenes (default forest)")
    parser.add_argument("--backend", choices=BACKENDS, default="torch", help="of the student (default torch)")
    parser.add_argument(
        "--voxel-bundles", choices=(GREEDY, "magnnet-bundling"), default=GREEDY, help=f"on the voxel grid (default {GREEDY})"
    )
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    return parser


def _records(
    scene: Scene, seed: int, warm_up: bool, pipelines: dict[str, Callable[[Scene, int], Outcome]]
) -> Iterator[dict[str, object]]:
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
            "flights_s": flights_s, "length": outcome.length, "any_angle": travel.total(outcome.bundles.routes),
            "best": travel.total(exact.bundles.routes if exact is not None else best.routes), "optimal": optimal,
            "clear_before": outcome.clear_before, "certified": certified,
        }  # fmt: skip


def _judged(scene: Scene, outcome: Outcome, travel: Travel) -> tuple[float, bool]:
    """Seconds to decoded flights, and whether the plan is certified once flights are kept apart; NaN if not decoded."""
    if outcome.travel is None:
        return float("nan"), False
    began = perf_counter()
    flights = decode(scene, outcome.bundles, outcome.samples, travel=outcome.travel)
    flights_s = outcome.ways_s + perf_counter() - began
    flights = deconflict(scene, outcome.bundles, flights, travel=travel).flights
    proof = lower_bound(scene, travel, bound="fast")
    cost = plan_cost(travel, outcome.bundles, flights, proof)
    plan = dataclasses.replace(draft_plan(scene, "scalability", outcome.bundles), flights=flights, cost=cost)
    return flights_s, certify(scene, plan, travel=travel, bound=proof).certified


def _column(records: list[dict[str, object]], pipeline: str, tasks: int, key: str) -> FloatArray:
    """(S,): one column of one pipeline, by scene."""
    chosen = [row[key] for row in records if (row["pipeline"], row["tasks"]) == (pipeline, tasks)]
    return np.array(chosen, dtype=np.float64)


def _summary(records: list[dict[str, object]], sizes: Sequence[int]) -> str:
    table = []
    for tasks in sizes:
        voxel = {name: _column(records, name, tasks, "ways_s") for name in ("voxel6", "voxel26")}
        far = {name: _column(records, name, tasks, "length") for name in voxel}
        optimal = _column(records, "classical", tasks, "optimal") > 0
        for name in NAMES:
            seconds, length = (_column(records, name, tasks, key) for key in ("ways_s", "length"))
            flights = spread(1e3 * _column(records, name, tasks, "flights_s"))
            faster = [float(np.median(other / seconds)) for other in voxel.values()]
            shorter = [100.0 * (1.0 - float(np.mean(length / other))) for other in far.values()]
            over_ways = 100.0 * float(np.mean(length / _column(records, name, tasks, "any_angle") - 1.0))
            over_best = (length / _column(records, name, tasks, "best") - 1.0)[optimal]
            table.append([
                tasks, name, *spread(1e3 * seconds), *flights, *faster, float(length.mean()), *shorter, over_ways,
                100.0 * float(over_best.mean()) if optimal.any() else float("nan"),
                100.0 * float(_column(records, name, tasks, "clear_before").mean()),
                100.0 * float(_column(records, name, tasks, "certified").mean()),
            ])  # fmt: skip
    columns = [
        "tasks", "pipeline", "ways ms", "p95", "flights ms", "p95", "x faster than voxel6", "than voxel26", "length m",
        "% shorter than voxel6", "than voxel26", "% over any-angle, same bundles", "% over the optimum", "clear before %",
        "certified %",
    ]  # fmt: skip
    medians = {name: [np.median(_column(records, name, tasks, "ways_s")) for tasks in (sizes[0], sizes[-1])] for name in NAMES}
    growth = [f"{name} {last / first:.2f}" for name, (first, last) in medians.items()]
    proven = sum(bool(row["optimal"]) for row in records if row["pipeline"] == "classical")
    notes = f"\nGrowth of the median time to ways from {sizes[0]} to {sizes[-1]} tasks: {', '.join(growth)}.\n"
    notes += f"Optima proven for {proven} scenes; voxel pipelines are not decoded, so not judged.\n"
    return "\n".join([header("Scalability", "benchmarks.scalability"), markdown_table(columns, table), notes])


def _plot(records: list[dict[str, object]], sizes: Sequence[int], path: Path) -> None:
    """Median milliseconds to ways, with bands from the 5th to the 95th percentile."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name in NAMES:
        columns = [1e3 * _column(records, name, tasks, "ways_s") for tasks in sizes]
        low, middle, high = np.array([np.quantile(column, (0.05, 0.5, 0.95)) for column in columns]).T
        (line,) = axes.plot(sizes, middle, marker="o", label=name)
        axes.fill_between(sizes, low, high, alpha=0.2, color=line.get_color())
    axes.set_xlabel("tasks")
    axes.set_ylabel("milliseconds from scene to ways")
    axes.set_yscale("log")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
