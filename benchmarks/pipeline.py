"""Whole pipelines on the five families, ten drones and twenty tasks, from scene to certificate (the paper's Table II).

    python -m benchmarks.pipeline --scenes 100 --seed 0 --out out/pipeline

MAGNNET and MAGNNET + bundling fly 6-connected voxel paths as in the paper; the teacher, the student's planners and the
classical ones any-angle or drawn ones. A pipeline whose weights are not there is left out, and named. Writes
``pipeline.csv`` (a row a scene and pipeline), ``summary.md``. "Route cost" is what the fleet flies on its pipeline's own
paths before decoding, "travel" the same bundles over shortest paths. Uncertified and failed plans stay and count.
The first scene of each family is planned once before, as a warm-up.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch

from benchmarks.report import Rows, header, markdown_table, spread, write_summary
from flockopt import FlockError, Scene, generate, plan
from flockopt.allocate.refine import refine_bundles
from flockopt.bundles import bundle_compactness, insertion_cost, tasks_per_drone_std
from flockopt.families import FAMILIES
from flockopt.plan import ANY_ANGLE, PLANNERS, Plan, Proposal, Request, classical
from flockopt.travel import compute_travel
from learned import planner as teacher_planners
from learned.student.planner import drawn_plan, hybrid, learned, searched_plan, shipped_student
from learned.ways import find_ways

__all__ = ["main"]

#: Added to the seeds, so that no scene is one that something was trained on.
UNSEEN = 70_000_000

#: Seconds the exact pipeline may take for its bundles.
EXACT_S = 20.0

#: Metres by which the hybrid may exceed the classical cost: what adding up in another order loses.
ROUNDING_M = 1e-6


def exact(request: Request) -> Proposal:
    """Proven optima, as far as the time goes."""
    settings = {"travel": request.travel, "seed": request.seed, "time_limit_s": EXACT_S}
    return Proposal(refine_bundles(request.scene, method="exact", **settings))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Pipeline:
    """A planner, and the paths it flies."""

    planner: str
    paths: str = ANY_ANGLE


#: The planners by the names they are registered under.
OURS = {
    "magnnet": teacher_planners.magnnet,
    "magnnet-bundling": teacher_planners.magnnet_bundling,
    "teacher": teacher_planners.teacher,
    "learned": learned,
    "hybrid": hybrid,
    "classical": classical,
    "exact": exact,
}
PIPELINES = {
    "magnnet, voxel6": Pipeline("magnnet", "voxel6"),
    "magnnet + bundling, voxel6": Pipeline("magnnet-bundling", "voxel6"),
    "magnnet + bundling": Pipeline("magnnet-bundling"),
    "teacher": Pipeline("teacher"),
    "learned": Pipeline("learned"),
    "hybrid": Pipeline("hybrid"),
    "classical": Pipeline("classical"),
    "exact": Pipeline("exact"),
}

MEASURES = {
    "coverage": "coverage %", "certified": "certified %", "clear_before": "clear before %", "fallback": "fallback %",
    "route_cost": "route cost m", "travel": "travel m", "compactness": "compactness", "insertion": "insertion cost m",
    "tasks_per_m": "tasks / m", "steps": "episode steps", "tasks_std": "tasks std", "makespan": "makespan s",
}  # fmt: skip
SHARES = ("coverage", "certified", "clear_before", "fallback")
COLUMNS = ("family", "scene", "seed", "pipeline", "status", "failed", *MEASURES, "total_s")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if the hybrid never costs more than the classical planner."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(1)
    PLANNERS.update({name: planner for name, planner in OURS.items() if name not in PLANNERS})
    left_out = _left_out()
    rows = Rows(options.out / "pipeline.csv", COLUMNS)
    chosen = {name: pipeline for name, pipeline in PIPELINES.items() if name not in left_out}
    for number in range(options.scenes):
        family = options.families[number % len(options.families)]
        scene = generate(family, drones=options.drones, tasks=options.tasks, seed=UNSEEN + options.seed + number)
        for name, pipeline in chosen.items():
            _warm_up(pipeline, family, options.drones, options.tasks)
            row = {"family": family, "scene": scene.sha256[:12], "seed": options.seed + number, "pipeline": name}
            rows.add(row | _measured(scene, pipeline, options.seed + number, options.time_limit))
        print(f"\r{number + 1}/{options.scenes}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    rows.close()
    worse = _worse(rows.records)
    write_summary(options.out, _summary(rows.records, left_out, worse))
    return 1 if worse else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pipeline", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenes", type=int, default=100, help="dealt to the families in turn (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="the first seed (default 0)")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES), help="(default all)")
    parser.add_argument("--drones", type=int, default=10, help="in each scene (default 10)")
    parser.add_argument("--tasks", type=int, default=20, help="in each scene (default 20)")
    parser.add_argument("--time-limit", type=float, help="seconds for each plan (default: each planner's own measure)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    return parser


def _left_out() -> dict[str, str]:
    """Pipelines whose weights are not there, and what is missing."""
    scene, missing = generate("forest", drones=2, tasks=2, seed=0), {}
    for name, pipeline in PIPELINES.items():
        try:
            plan(scene, planner=pipeline.planner, paths=pipeline.paths)
        except FlockError as fault:
            missing[name] = str(fault)
    return missing


@cache
def _warm_up(pipeline: Pipeline, family: str, drones: int, tasks: int) -> None:
    plan(generate(family, drones=drones, tasks=tasks, seed=0), planner=pipeline.planner, paths=pipeline.paths, time_limit_s=1.0)


def _measured(scene: Scene, pipeline: Pipeline, seed: int, time_limit_s: float | None) -> dict[str, object]:
    """The plan of one pipeline in the paper's measures."""
    try:
        result = plan(scene, planner=pipeline.planner, paths=pipeline.paths, seed=seed, time_limit_s=time_limit_s)
    except FlockError as fault:
        return {"status": "error", "failed": str(fault), **dict.fromkeys(MEASURES, float("nan")), "total_s": float("nan")}
    travel = compute_travel(scene)
    names = {task.id: index for index, task in enumerate(scene.tasks)}
    routes = [[names[task] for task in result.routes.get(drone.id, ())] for drone in scene.drones]
    served = sum(map(len, routes))
    cost = find_ways(scene, pipeline.paths, travel=travel).travel.total(routes)
    failed = [] if result.certificate is None else [clause.name for clause in result.certificate.failed]
    return {
        "status": result.status, "failed": " ".join(failed) or result.reason, "total_s": result.timing["total"],
        "coverage": served / scene.num_tasks, "certified": result.status == "certified",
        "clear_before": _clear_before(scene, pipeline, seed), "fallback": "fallback" in result.timing,
        "route_cost": cost, "travel": result.cost.travel, "tasks_per_m": served / cost if cost else float("nan"),
        "compactness": _number(bundle_compactness(routes, scene.task_positions)), "makespan": result.cost.makespan,
        "insertion": _number(insertion_cost(travel, routes)), "tasks_std": tasks_per_drone_std(routes), "steps": _steps(result),
    }  # fmt: skip


def _clear_before(scene: Scene, pipeline: Pipeline, seed: int) -> float:
    """Whether the student's ways need no mending: 1 or 0; NaN where no student draws."""
    propose = {"learned": drawn_plan, "hybrid": searched_plan}.get(pipeline.planner)
    if propose is None:
        return float("nan")
    _, drawing, _ = propose(shipped_student(), Request(scene, compute_travel(scene), None, seed))
    return float(drawing is not None and drawing.clear.all())


def _steps(result: Plan) -> float:
    """Steps of the allocation episode; 1 where all is allocated at once."""
    return 1.0 if result.episode_steps is None else float(result.episode_steps)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _worse(records: list[dict[str, object]]) -> list[str]:
    """Scenes in which the hybrid travels farther than the classical planner."""
    travel = {(row["pipeline"], row["scene"]): float(row["travel"]) for row in records}  # type: ignore[arg-type]
    return [
        str(scene)
        for (name, scene), value in travel.items()
        if name == "hybrid" and not value <= travel["classical", scene] + ROUNDING_M
    ]


def _summary(records: list[dict[str, object]], left_out: dict[str, str], worse: list[str]) -> str:
    table, costs = [], {}
    for name in dict.fromkeys(str(row["pipeline"]) for row in records):
        rows = [row for row in records if row["pipeline"] == name]
        means = {key: _mean([row[key] for row in rows]) * (100.0 if key in SHARES else 1.0) for key in MEASURES}
        costs[name] = means["route_cost"]
        median, late = spread([1e3 * float(row["total_s"]) for row in rows])  # type: ignore[arg-type]
        table.append([name, len(rows), *means.values(), median, late])
    lines = [header("Pipelines", "benchmarks.pipeline")]
    lines += [markdown_table(["pipeline", "scenes", *MEASURES.values(), "plan ms", "p95 ms"], table)]
    baseline = costs.get("magnnet + bundling, voxel6")
    for name, cost in costs.items() if baseline is not None else ():
        lines += [f"- {name}: route cost {100 * (1 - cost / baseline):.1f} % under MAGNNET + bundling on voxels"]
    lines += [f"- left out: {name} ({words})" for name, words in left_out.items()]
    lines += [f"- the hybrid travels farther than the classical planner in {len(worse)} scenes {' '.join(worse)}".rstrip()]
    return "\n".join(lines) + "\n"


def _mean(values: Sequence[object]) -> float:
    known = [float(value) for value in values if np.isfinite(float(value))]  # type: ignore[arg-type]
    return float(np.mean(known)) if known else float("nan")


if __name__ == "__main__":
    raise SystemExit(main())
