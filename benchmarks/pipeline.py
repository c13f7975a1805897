"""Whole pipelines on the five families, ten drones and twenty tasks, from scene to flight (the paper's Table II).

    python -m benchmarks.pipeline --scenes 100 --seed 0 --out out/pipeline

MAGNNET and MAGNNET + bundling fly 6-connected voxel paths as in the paper; the teacher, the student's planners and the
classical ones any-angle or drawn ones. ``hybrid`` and ``classical`` are asked a second time with a time limit. A pipeline
whose weights are not there is left out, and named. "Route cost" is what the fleet flies on its pipeline's own paths before
decoding, "travel" the same bundles over shortest paths; "clear before" is what the student draws before any mending.
Every plan is flown in PyBullet, uncertified ones too; plans keep room for tracking errors, as `sim` does. Uncertified and
failed plans stay and count. Writes ``pipeline.csv`` (a row a scene and pipeline) and ``summary.md``. The first scene of
each family is planned once before, as a warm-up.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import FlockError, Scene, generate, plan
from flockopt.bundles.bundles import bundle_compactness, insertion_cost, tasks_per_drone_std
from flockopt.certificate import Plan
from flockopt.planning.planners import ANY_ANGLE, PLANNERS, Planner, Request
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel
from learned.paths.ways import find_ways
from learned.student.planner import (
    HYBRID,
    LEARNED,
    LEARNED_PAPER,
    PAPER_WEIGHTS,
    WEIGHTS,
    drawn_plan,
    searched_plan,
    shipped_student,
)
from learned.teacher.planner import MAGNNET, MAGNNET_BUNDLING, TEACHER
from sim.mission.execute import execute
from sim.trials.trial import TRACKING_MARGIN_M

__all__ = ["main"]

#: Added to the seeds, so that no scene is one that something was trained on.
UNSEEN = 70_000_000

#: Seconds the exact pipeline may take.
EXACT_S = 20.0

#: Metres by which the hybrid may exceed the classical cost: what adding up in another order loses.
ROUNDING_M = 1e-6


@dataclass(frozen=True)
class Pipeline:
    """A planner, the paths it flies, and whether its time is limited: as the command line says, or to so many seconds."""

    planner: Planner
    paths: str = ANY_ANGLE
    limited: bool = False
    most_s: float | None = None


CLASSICAL = PLANNERS["classical"]

PIPELINES = {
    "magnnet, voxel6": Pipeline(MAGNNET, "voxel6"),
    "magnnet + bundling, voxel6": Pipeline(MAGNNET_BUNDLING, "voxel6"),
    "magnnet + bundling": Pipeline(MAGNNET_BUNDLING),
    "teacher": Pipeline(TEACHER),
    "paper's student": Pipeline(LEARNED_PAPER),
    "learned": Pipeline(LEARNED),
    "hybrid": Pipeline(HYBRID),
    "classical": Pipeline(CLASSICAL),
    "exact": Pipeline(PLANNERS["exact"], most_s=EXACT_S),
    "hybrid, limited": Pipeline(HYBRID, limited=True),
    "classical, limited": Pipeline(CLASSICAL, limited=True),
}

MEASURES = {
    "coverage": "coverage %", "certified": "certified %", "clear_before": "clear before %", "fallback": "fallback %",
    "route_cost": "route cost m", "travel": "travel m", "compactness": "compactness", "insertion": "insertion cost m",
    "tasks_per_m": "tasks / m", "steps": "episode steps", "tasks_std": "tasks std", "makespan": "makespan s",
    "completion": "flown: completion %", "contacts": "contacts", "room": "least clearance - asked mm", "error": "mean error mm",
}  # fmt: skip
SHARES = ("coverage", "certified", "clear_before", "fallback", "completion")
#: Measures of which the worst scene counts, not the mean.
LEAST, SUMMED = ("room",), ("contacts",)
#: The stages that are spent on paths; what else a proposal takes is allocation and generation.
PATH_STAGES = ("travel", "oracle", "legs")
SECONDS = ("allocation_s", "paths_s", "total_s")
COLUMNS = ("family", "scene", "seed", "pipeline", "status", "failed", *MEASURES, *SECONDS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if the hybrid never costs more than the classical planner."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(1)
    left_out = _left_out()
    rows = CsvRows(options.out / "pipeline.csv", COLUMNS)
    chosen = {name: pipeline for name, pipeline in PIPELINES.items() if name not in left_out}
    for number in range(options.scenes):
        family, seed = options.families[number % len(options.families)], options.seed + number
        scene = generate(family, drones=options.drones, tasks=options.tasks, seed=UNSEEN + seed)
        for name, pipeline in chosen.items():
            _warm_up(pipeline, family, options.drones, options.tasks)
            limit_s = options.time_limit if pipeline.limited else pipeline.most_s
            row = {"family": family, "scene": scene.sha256[:12], "seed": seed, "pipeline": name}
            rows.add(row | _measured(scene, pipeline, seed, limit_s))
        tell(f"{number + 1}/{options.scenes}")
    tell("\n")
    rows.close()
    worse = {name: _worse(rows.records, name) for name in ("", ", limited")}
    write_summary(options.out, _summary(rows.records, left_out, worse))
    return 1 if any(worse.values()) else 0


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("pipeline", __doc__)
    parser.add_argument("--scenes", type=int, default=100, help="dealt to the families in turn (default 100)")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES), help="(default all)")
    parser.add_argument("--drones", type=int, default=10, help="in each scene (default 10)")
    parser.add_argument("--tasks", type=int, default=20, help="in each scene (default 20)")
    parser.add_argument("--time-limit", type=float, default=0.5, help="seconds for limited plans (default 0.5)")
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


def _measured(scene: Scene, pipeline: Pipeline, seed: int, time_limit_s: float | None) -> Record:
    """The plan of one pipeline, and its flight, in the paper's measures."""
    try:
        result = plan(
            scene, planner=pipeline.planner, paths=pipeline.paths, seed=seed, time_limit_s=time_limit_s,
            tracking_margin_m=TRACKING_MARGIN_M,
        )  # fmt: skip
    except FlockError as fault:
        return {"status": "error", "failed": str(fault), **dict.fromkeys((*MEASURES, *SECONDS), float("nan"))}
    travel = compute_travel(scene)
    names = {task.id: index for index, task in enumerate(scene.tasks)}
    routes = [[names[task] for task in result.routes.get(drone.id, ())] for drone in scene.drones]
    served = sum(map(len, routes))
    cost = find_ways(scene, pipeline.paths, travel=travel).travel.total(routes)
    failed = [] if result.certificate is None else [clause.name for clause in result.certificate.failed]
    return {
        "status": result.status, "failed": " ".join(failed) or result.reason, **_seconds(result),
        "coverage": served / scene.num_tasks, "certified": result.status == "certified",
        "clear_before": _clear_before(scene, pipeline, seed), "fallback": "fallback" in result.timing,
        "route_cost": cost, "travel": result.cost.travel, "tasks_per_m": served / cost if cost else float("nan"),
        "compactness": _number(bundle_compactness(routes, scene.task_positions)), "makespan": result.cost.makespan,
        "insertion": _number(insertion_cost(travel, routes)), "tasks_std": tasks_per_drone_std(routes), "steps": _steps(result),
        **_flown(scene, result, travel),
    }  # fmt: skip


def _seconds(result: Plan) -> dict[str, float]:
    """Seconds of allocation and generation, on paths, and of the whole plan."""
    paths_s = sum(result.timing.get(stage, 0.0) for stage in PATH_STAGES)
    proposal_s = result.timing["travel"] + result.timing["allocate"]
    return dict(zip(SECONDS, (proposal_s - paths_s, paths_s, result.timing["total"]), strict=True))


def _flown(scene: Scene, result: Plan, travel: Travel) -> dict[str, float]:
    """What PyBullet makes of the plan; NaN where there is nothing to fly."""
    if not result.flights:
        return dict.fromkeys(("completion", "contacts", "room", "error"), float("nan"))
    flight = execute(scene, result, force=True, travel=travel)
    room_m = _number(flight.measures.min_clearance) - scene.clearance
    return {
        "completion": flight.measures.completion, "contacts": float(len(flight.touches)), "room": 1e3 * room_m,
        "error": 1e3 * flight.measures.mean_tracking_error,
    }  # fmt: skip


def _clear_before(scene: Scene, pipeline: Pipeline, seed: int) -> float:
    """Whether the student's ways need no mending: 1 or 0; NaN where no student draws."""
    drawers = {
        LEARNED_PAPER: (drawn_plan, PAPER_WEIGHTS),
        LEARNED: (drawn_plan, WEIGHTS),
        HYBRID: (searched_plan, WEIGHTS),
    }
    if pipeline.planner not in drawers:
        return float("nan")
    propose, weights = drawers[pipeline.planner]
    _, drawing, _ = propose(shipped_student(weights), Request(scene, compute_travel(scene), None, seed))
    return float(drawing is not None and drawing.clear.all())


def _steps(result: Plan) -> float:
    """Steps of the allocation episode; 1 where all is allocated at once."""
    return 1.0 if result.episode_steps is None else float(result.episode_steps)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _worse(records: list[Record], suffix: str) -> list[str]:
    """Scenes in which the hybrid travels farther than the classical planner, or serves less."""
    by_case = {(row["pipeline"], row["scene"]): row for row in records}
    worse = []
    for (name, scene), row in by_case.items():
        if name == f"hybrid{suffix}":
            other = by_case[f"classical{suffix}", scene]
            is_as_good = float(row["travel"]) <= float(other["travel"]) + ROUNDING_M
            if not (is_as_good and row["coverage"] >= other["coverage"]):
                worse.append(str(scene))
    return worse


def _summary(records: list[Record], left_out: dict[str, str], worse: dict[str, list[str]]) -> str:
    table: list[list[object]] = []
    costs: dict[str, float] = {}
    for name in dict.fromkeys(str(row["pipeline"]) for row in records):
        rows = [row for row in records if row["pipeline"] == name]
        cells = {key: _cell(key, [row[key] for row in rows]) for key in MEASURES}
        costs[name] = cells["route_cost"]
        times = [1e3 * float(np.nanmedian([row[key] for row in rows])) for key in SECONDS]
        _, late = spread([1e3 * float(row["total_s"]) for row in rows])
        table.append([name, len(rows), *cells.values(), *times, late])
    columns = ["pipeline", "scenes", *MEASURES.values(), "allocation, generation ms", "paths ms", "plan ms", "p95 ms"]
    lines = [header("Pipelines", "benchmarks.pipeline"), markdown_table(columns, table)]
    baseline = costs.get("magnnet + bundling, voxel6", float("nan"))
    for name, cost in costs.items() if np.isfinite(baseline) else ():
        lines += [f"- {name}: route cost {100 * (1 - cost / baseline):.1f} % under MAGNNET + bundling on voxels"]
    lines += [f"- left out: {name} ({words})" for name, words in left_out.items()]
    for suffix, scenes in worse.items():
        lines += [
            f"- hybrid{suffix} travels farther than classical{suffix} in {len(scenes)} scenes {' '.join(scenes)}".rstrip()
        ]
    return "\n".join(lines) + "\n"


def _cell(key: str, values: Sequence[float]) -> float:
    """A measure over scenes: shares in per cent; NaN where nothing has it."""
    known = [float(value) for value in values if np.isfinite(float(value))]
    if not known:
        return float("nan")
    whole = min(known) if key in LEAST else sum(known) if key in SUMMED else float(np.mean(known))
    return whole * (100.0 if key in SHARES else 1.0)


if __name__ == "__main__":
    raise SystemExit(main())
