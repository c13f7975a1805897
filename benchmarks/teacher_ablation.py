"""The paper's Table I: allocators by learned policies, with and without bundling and refinement, flown in PyBullet.

    python -m benchmarks.teacher_ablation --scenes 100 --seed 0 --out out/teacher_ablation

Scenes are dealt to the families in turn; the allocators were trained on seeds from 900,000 up. Writes
``teacher_ablation.csv`` (a row a scene and method), ``summary.md`` and ``teacher_ablation.png``; killed and started again
it goes on where it stopped. Every method's bundles are flown along any-angle paths, certified or not, so that a
policy that leaves tasks out is measured too; the costs of the same bundles on voxel grids stand beside.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

from benchmarks.allocators import nearest_task
from benchmarks.report import CsvRows, Record, benchmark_parser, write_summary
from benchmarks.table_one import draw, summary
from flockopt import SettingsError
from flockopt.batches.backends import BACKENDS
from flockopt.batches.progress import ProgressBar
from flockopt.bundles.exact.exact import solve_exact
from flockopt.bundles.explain import explained
from flockopt.cli.status import run_command
from flockopt.planning.planners import PLANNERS, Planner, Proposal, Request
from flockopt.records import checks
from flockopt.scene import Scene
from flockopt.scene.families.layouts import FAMILIES
from learned.paths.ways import PATHS, find_ways
from learned.teacher.planner import MAGNNET, MAGNNET_BUNDLING, TEACHER, TEACHER_UNREFINED, refined
from sim.trials.batch import run_batch
from sim.trials.journal import Journal
from sim.trials.trial import Result, Trial, run_trial

__all__ = ["METHODS", "main"]

#: Seconds the exact method may take to prove an optimum.
PROOF_S = 60.0

#: Bundles by a method, and what else is known of them.
Method: TypeAlias = Callable[[Request], tuple[Proposal, dict[str, float]]]


def _plainly(planner: Planner, request: Request) -> tuple[Proposal, dict[str, float]]:
    return planner.propose(request), {}


def _nearest(request: Request) -> Proposal:
    return Proposal(nearest_task(request.scene, request.travel, request.seed))


NEAREST = Planner(_nearest, "nearest")


def _then_refined(planner: Planner, request: Request) -> tuple[Proposal, dict[str, float]]:
    """The same refinement as the teacher's after another method: what it is worth by itself."""
    first = planner.propose(request)
    (routes,) = refined([request.scene], [request.travel], [first.bundles.routes])
    return replace(first, bundles=explained(request.scene, request.travel, routes)), {}


def _exact(request: Request) -> tuple[Proposal, dict[str, float]]:
    result = solve_exact(request.scene, request.travel, time_limit_s=PROOF_S, seed=request.seed)
    return Proposal(result.bundles), {"proven": result.proven, "is_optimal": float(result.status == "optimal")}


#: Methods by name, in the order of the table.
METHODS: dict[str, Method] = {
    "magnnet": partial(_plainly, MAGNNET),
    "magnnet-bundling": partial(_plainly, MAGNNET_BUNDLING),
    "teacher": partial(_plainly, TEACHER),
    "teacher-unrefined": partial(_plainly, TEACHER_UNREFINED),
    "magnnet-bundling-refined": partial(_then_refined, MAGNNET_BUNDLING),
    "nearest": partial(_plainly, NEAREST),
    "nearest-refined": partial(_then_refined, NEAREST),
    "search": partial(_plainly, PLANNERS["classical"]),
    "exact": _exact,
}

COLUMNS = (
    "scene", "family", "seed", "method", "status", "failed", "planner_coverage", "execution_completion", "contacts", "cost",
    "cost_voxel26", "cost_voxel6", "length", "bundle_compactness", "insertion_cost", "tasks_per_distance", "episode_steps",
    "tasks_per_drone_std", "makespan", "lower_bound", "gap_to_optimum", "is_optimal", "allocate_s",
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if every method but MAGNNET served all tasks of all scenes in flight."""
    options = _parser().parse_args(argv)
    return run_command("benchmarks.teacher_ablation", lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    records = _records(options)
    rows = CsvRows(options.out / "teacher_ablation.csv", COLUMNS)
    for record in records:
        rows.add({column: "" if record.get(column) is None else record[column] for column in COLUMNS})
    rows.close()
    write_summary(options.out, summary(records))
    draw(records, options.out / "teacher_ablation.png")
    return 0 if all(record["execution_completion"] == 1.0 for record in records if record["method"] != "magnnet") else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("teacher_ablation", __doc__)
    parser.add_argument("--scenes", type=int, default=100, help="how many, over all families (default 100)")
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(FAMILIES), help="dealt scenes in turn")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS), help="what to compare")
    parser.add_argument("--drones", type=int, default=10, help="in each scene (default 10)")
    parser.add_argument("--tasks", type=int, default=20, help="in each scene (default 20)")
    parser.add_argument("--jobs", type=int, default=1, help="flights side by side (default 1)")
    parser.add_argument("--backend", default="loky", help=f"where they run: {', '.join(BACKENDS)} (default loky: processes)")
    return parser


def _records(options: argparse.Namespace) -> list[Record]:
    """All rows, flown now or before."""
    scenes = checks.integer(SettingsError, "scenes", options.scenes, least=1)
    jobs = checks.integer(SettingsError, "jobs", options.jobs, least=1)
    first = checks.integer(SettingsError, "seed", options.seed, least=0)
    cases = [(options.families[index % len(options.families)], first + index) for index in range(scenes)]
    bar = ProgressBar(len(options.methods) * scenes)
    found: dict[tuple[str, str], Record] = {}
    for method in options.methods:
        trials = [Trial(family, options.drones, options.tasks, seed, method, force=True) for family, seed in cases]
        terms = trials[0].terms() | {"family": sorted(options.families)}
        with Journal(options.out / method, terms) as journal:
            for trial in trials:
                if trial.key in journal:
                    bar.advance("")
            run_batch(
                trials, journal, jobs=jobs, backend=options.backend, work=fly,
                done=partial(_tell, bar, method), warn=bar.note,
            )  # fmt: skip
            results = journal.results
            for trial in trials:
                result = results[trial.key]
                found[method, trial.key] = {**result.row, "method": method, "allocate_s": result.timing.get("allocate_s")}
    bar.close()
    return _compared(found)


def _tell(bar: ProgressBar, method: str, result: Result) -> None:
    bar.advance(f"{method} {result.key}")


def fly(trial: Trial) -> Result:
    """Allocate by the method that the trial's planner names, plan, fly, and price the bundles on voxel grids too."""
    known: dict[str, Any] = {}
    name = str(trial.planner)

    def propose(request: Request) -> Proposal:
        proposal, more = METHODS[name](request)
        known.update(more, proposal=proposal, scene=request.scene)
        return proposal

    result = run_trial(replace(trial, planner=Planner(propose, name)))
    proposal, scene = known.pop("proposal", None), known.pop("scene", None)
    costs = {} if proposal is None else _voxel_costs(scene, proposal)
    return Result(result.key, {**result.row, **known, **costs}, result.timing)


def _voxel_costs(scene: Scene, proposal: Proposal) -> dict[str, float]:
    grids = [paths for paths in PATHS if paths.startswith("voxel")]
    return {f"cost_{paths}": find_ways(scene, paths).travel.total(proposal.bundles.routes) for paths in grids}


def _compared(found: Mapping[tuple[str, str], Record]) -> list[Record]:
    """The rows with their gaps to the optimum, where that is proven; plans that leave tasks out have none."""
    for (_, scene), record in found.items():
        exact = found.get(("exact", scene), {})
        is_whole = record["planner_coverage"] == 1.0 and record["cost"] is not None
        if exact.get("is_optimal") and is_whole:
            record["gap_to_optimum"] = max(record["cost"] / exact["proven"] - 1.0, 0.0) if exact["proven"] > 0.0 else 0.0
    return list(found.values())


if __name__ == "__main__":
    raise SystemExit(main())
