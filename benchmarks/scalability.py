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
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from time import perf_counter, process_time
from typing import TypeAlias

import numpy as np
import torch

from benchmarks.report import CsvRows, header, markdown_table, spread, write_summary
from flockopt import Scene, generate, refine_bundles
from flockopt.bundles import Bundles
from flockopt.bundles.bounds.bounds import lower_bound
from flockopt.bundles.exact.exact import solve_exact
from flockopt.certificate.judge import certify
from flockopt.errors import MissingExtra
from flockopt.flights.apart.deconflict import deconflict
from flockopt.flights.decode import decode
from flockopt.flights.waypoints import waypoints_from_samples
from flockopt.planning.finish import draft_plan, plan_cost
from flockopt.planning.planners import Request, classical
from flockopt.records.arrays import FloatArray
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel
from flockopt.travel.travel import straight_travel
from learned.paths.rollout import route_legs
from learned.paths.voxels import VoxelSettings, voxel_oracle
from learned.student.backends.choice import network
from learned.student.inference import DrawnFleet, Network, decide
from learned.student.network.model import Student
from learned.student.network.rows import rows_of
from learned.student.planner import STEPS, drawn_plans, searched_plan, shipped_student
from learned.student.pulling import ways_of
from learned.student.scenes.batch import collate
from learned.student.scenes.examples import example
from learned.teacher.planner import magnnet_bundling

__all__ = ["main"]

#: Added to the seeds, so that no scene is one of the demonstrations, whose seeds start at 0.
UNSEEN = 60_000_000

#: Seconds for the proven optimum of a scene; where they do not suffice, the scene counts for the other columns only.
EXACT_S = 2.0

#: Scenes of each size that are not counted.
WARM_UP = 3

#: Scenes that are planned in one pass, and the first seed of those that fill a batch up.
BATCH, COMPANY = 16, 70_000_000

OPENVINO, BATCHES = "learned, openvino", f"learned, batches of {BATCH}"

NAMES = ("learned", OPENVINO, BATCHES, "hybrid", "classical", "voxel6", "voxel26", "voxel6-greedy")

#: What ratios are taken to.
VOXEL = ("voxel6", "voxel26", "voxel6-greedy")

COLUMNS = (
    "scene", "tasks", "seed", "pipeline", "ways_s", "wall_s", "flights_s", "length", "any_angle", "best", "optimal",
    "clear_before", "certified",
)  # fmt: skip


@dataclass(frozen=True)
class WaysFound:
    """What a pipeline made of a scene.

    Attributes:
        bundles: Which drone visits what.
        length: Metres, of the ways.
        ways_s: CPU seconds to the ways.
        wall_s: The same on the wall.
        travel: To decode with; None for pipelines that are not decoded.
        samples: (N, T, 3) m control points, where the ways come from a student.
        clear_before: Whether no way had to be mended.
    """

    bundles: Bundles
    length: float
    ways_s: float
    wall_s: float
    travel: Travel | None = None
    samples: FloatArray | None = None
    clear_before: bool = True


class Clock:
    """Runs from when it is made."""

    def __init__(self) -> None:
        self._cpu_s, self._wall_s = process_time(), perf_counter()

    def read(self) -> tuple[float, float]:
        """CPU seconds and seconds on the wall."""
        return process_time() - self._cpu_s, perf_counter() - self._wall_s


def by_learning(student: Network, scene: Scene, seed: int, company: Sequence[Scene] = ()) -> WaysFound:
    """The student without any search for paths, unless a way comes out blocked.

    With company, other scenes that are planned in the same pass, seconds are one scene's share.
    """
    clock = Clock()
    requests = [Request(one, straight_travel(one), None, seed) for one in (scene, *company)]
    fleets = []
    for request, (bundles, drawing, _) in zip(requests, drawn_plans(student, requests), strict=True):
        travel = request.travel
        if drawing is not None and not drawing.clear.all():
            travel = compute_travel(request.scene, routes=bundles.routes)
        fleets.append((_mended(request.scene, bundles, drawing, travel), bundles, travel, drawing))
    shares = [seconds / len(requests) for seconds in clock.read()]
    return _drawn_outcome(*fleets[0], *shares)


def by_batches(student: Network, family: str, scene: Scene, seed: int) -> WaysFound:
    """`by_learning` of as many scenes at a time as `BATCH`, all of one size."""
    return by_learning(student, scene, seed, _company(family, scene.num_drones, scene.num_tasks))


@cache
def _company(family: str, drones: int, tasks: int) -> list[Scene]:
    """The scenes that fill a batch up."""
    return [generate(family, drones=drones, tasks=tasks, seed=COMPANY + number) for number in range(BATCH - 1)]


def by_both(student: Network, scene: Scene, seed: int) -> WaysFound:
    """The hybrid: searches over any-angle travel, and the student's ways."""
    clock = Clock()
    travel = compute_travel(scene)
    bundles, drawing, _ = searched_plan(student, Request(scene, travel, None, seed))
    ways = _mended(scene, bundles, drawing, travel)
    return _drawn_outcome(ways, bundles, travel, drawing, *clock.read())


def _mended(scene: Scene, bundles: Bundles, drawing: DrawnFleet | None, travel: Travel) -> list[FloatArray]:
    """The drawn ways, with shortest paths where they are blocked."""
    if drawing is None:
        raise RuntimeError(f"{scene.name} has more legs a drone than the student has samples")
    ways = ways_of(drawing.example, drawing.samples)
    for drone in np.flatnonzero(~drawing.clear):
        mended = waypoints_from_samples(scene, travel, int(drone), bundles.routes[drone], drawing.samples[drone])
        ways[drone] = mended.points
    return ways


def _drawn_outcome(
    ways: list[FloatArray], bundles: Bundles, travel: Travel, drawing: DrawnFleet, ways_s: float, wall_s: float
) -> WaysFound:
    return WaysFound(bundles, sum(map(_length, ways)), ways_s, wall_s, travel, drawing.samples, bool(drawing.clear.all()))


def classically(scene: Scene, seed: int) -> WaysFound:
    """Any-angle travel and search."""
    clock = Clock()
    travel = compute_travel(scene)
    bundles = classical(Request(scene, travel, None, seed)).bundles
    for drone, route in enumerate(bundles):
        route_legs(scene, drone, route, travel.path)
    seconds = clock.read()
    return WaysFound(bundles, travel.total(bundles.routes), *seconds, travel)


def on_voxels(paths: str, scene: Scene, seed: int) -> WaysFound:
    """Dijkstra's costs, MAGNNET + bundling, A* legs."""
    clock = Clock()
    proposal = magnnet_bundling(Request(scene, straight_travel(scene), None, seed, paths=paths))
    seconds = clock.read()
    return WaysFound(proposal.bundles, sum(map(_length, np.asarray(proposal.samples))), *seconds)


def greedily_on_voxels(scene: Scene, seed: int) -> WaysFound:
    """6-connected Dijkstra's costs, greedy bundles, A* legs."""
    clock = Clock()
    oracle = voxel_oracle(scene, VoxelSettings(6))
    bundles = refine_bundles(scene, travel=oracle.travel, iterations=0, seed=seed)
    ways = [leg for drone, route in enumerate(bundles) for leg in route_legs(scene, drone, route, oracle.leg)]
    seconds = clock.read()
    return WaysFound(bundles, sum(map(_length, ways)), *seconds)


def _length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


WayFinder: TypeAlias = Callable[[Scene, int], WaysFound]


def _pipelines(family: str) -> dict[str, WayFinder]:
    """The pipelines by name; without OpenVINO's where that is not installed."""
    student = shipped_student()
    torch_student = network(student, "torch")
    pipelines: dict[str, WayFinder] = {"learned": partial(by_learning, torch_student)}
    try:
        pipelines[OPENVINO] = partial(by_learning, _compiled(student))
    except MissingExtra as fault:
        print(f"benchmarks.scalability: {fault}", file=sys.stderr)
    return pipelines | {
        BATCHES: partial(by_batches, torch_student, family),
        "hybrid": partial(by_both, torch_student),
        "classical": classically,
        "voxel6": partial(on_voxels, "voxel6"),
        "voxel26": partial(on_voxels, "voxel26"),
        "voxel6-greedy": greedily_on_voxels,
    }


def _compiled(student: Student) -> Network:
    """The student by OpenVINO, its sampler compiled for one to eight drones at a time before any clock runs."""
    compiled = network(student, "openvino-f32")
    scene = generate("forest", drones=10, tasks=20, seed=UNSEEN)
    one = example(scene, refine_bundles(scene, travel=straight_travel(scene), iterations=0).routes)
    _, tokens = decide(compiled, collate([one]))
    for count in (1, 2, 4, 8):
        places = [(0, drone) for drone in range(count)]
        noise = torch.zeros(count, student.settings.num_samples, 3)
        for steps in STEPS:
            compiled.sample(rows_of(student.settings, tokens, [one], places), noise, steps)
    return compiled


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    pipelines = _pipelines(options.family)
    rows = CsvRows(options.out / "scalability.csv", COLUMNS)
    for tasks in options.tasks:
        for number in range(-WARM_UP, options.scenes):
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
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    return parser


def _records(scene: Scene, seed: int, warm_up: bool, pipelines: dict[str, WayFinder]) -> Iterator[dict[str, object]]:
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


def _names(records: list[dict[str, object]]) -> list[str]:
    """The pipelines that were run, in order."""
    return [name for name in NAMES if any(row["pipeline"] == name for row in records)]


def _growth(records: list[dict[str, object]], name: str, sizes: Sequence[int]) -> float:
    """How many times the median time to ways of the most tasks is that of the fewest."""
    first, last = (np.median(_column(records, name, tasks, "ways_s")) for tasks in (sizes[0], sizes[-1]))
    return float(last / first)


def _plot(records: list[dict[str, object]], sizes: Sequence[int], path: Path) -> None:
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
