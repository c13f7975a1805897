"""What each part of the student is worth, on forests with near-optimal bundles, among walls, and on hard scenes.

    python -m benchmarks.student_ablation --scenes 100 --seed 0 --out out/student-ablation

Trajectories: how often scenes, drones and blocked drones (those with a leg whose straight line is not clear) are clear
before any mending, by DDIM steps and tries, beside plain straight lines; and how much longer the clear ways of blocked
drones are than the shortest ones. Allocation: what refinement makes of the head's probabilities, of none and of
nearness, by iterations and at equal time. Other students stand beside the first with ``--weights FILE FILE ...``, named by
their files' folders: docs/student.md says how those of its table were trained. Writes ``trajectories.csv``,
``allocation.csv`` (a row a scene and variant) and ``summary.md``. Scenes are not those that the shipped weights were
trained on. The first scene of each kind is a warm-up and not counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np
import torch

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import Scene, refine_bundles
from flockopt.records.arrays import FloatArray
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel
from flockopt.travel.travel import straight_travel
from learned.demonstrations.scenes import SceneMix, draw_scene, random_bundles
from learned.student.checkpoint import load_student
from learned.student.inference import draw, task_probabilities
from learned.student.network.model import Student
from learned.student.planner import STEPS, TRIES, WEIGHTS
from learned.student.scenes.batch import collate
from learned.student.scenes.examples import Example, example

__all__ = ["main"]

#: Added to the seeds, so that no scene is one of the demonstrations, whose seeds start at 0.
UNSEEN = 50_000_000

#: DDIM steps and tries of the first student, and of the others; 0 steps are the straight lines, a pair those of the first
#: try and of the others, as the planners draw.
VARIANTS = ((0, 1), (1, 1), (2, 1), (5, 1), (STEPS, TRIES), (2, 4), (2, 16), (2, 64))
OTHER_VARIANTS = ((2, 1), (2, 4))

Steps: TypeAlias = int | tuple[int, int]

#: Iterations of the refinement, and milliseconds that it may take together with what it starts from.
ITERATIONS, BUDGETS_MS = (0, 20, 100, 1000), (5, 20)

#: What stands in the way in each kind of scene, and where bundles are drawn at random.
KINDS = {"forest": ("forest",), "walls": ("corridor", "warehouse", "rooms"), "hard": ("forest",)}

TRAJECTORY_COLUMNS = (
    "scene", "kind", "seed", "student", "steps", "tries", "scene_clear", "drones", "drones_clear", "blocked",
    "blocked_clear", "detour", "seconds",
)  # fmt: skip
ALLOCATION_COLUMNS = ("scene", "seed", "preferences", "effort", "cost", "best_known", "accuracy", "seconds")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    students = {_name(path): load_student(path) for path in options.weights}
    first = next(iter(students.values()))
    trajectories = CsvRows(options.out / "trajectories.csv", TRAJECTORY_COLUMNS)
    allocation = CsvRows(options.out / "allocation.csv", ALLOCATION_COLUMNS)
    for kind in KINDS:
        for number in range(-1, options.scenes):
            scene, travel, base = _case(kind, UNSEEN + options.seed + number, number, first.settings.num_samples)
            case = {"kind": kind, "seed": options.seed + number}
            for record in _trajectory_rows(students, base, travel):
                if number >= 0:
                    trajectories.add(case | record)
            for record in _allocation_rows(first, scene, travel) if kind == "forest" else ():
                if number >= 0:
                    allocation.add({"seed": case["seed"], **record})
            tell(f"{kind}: {number + 1}/{options.scenes}")
    tell("\n")
    trajectories.close()
    allocation.close()
    write_summary(options.out, _summary(trajectories.records, allocation.records))
    return 0


def _name(path: Path) -> str:
    """What a student is called in the tables: the shipped one by its file, others by the folder of their run."""
    return path.stem if path.stem != "student" else path.parent.name


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("student_ablation", __doc__)
    parser.add_argument("--scenes", type=int, default=100, help="of each kind (default 100)")
    parser.add_argument(
        "--weights", type=Path, nargs="+", default=[WEIGHTS], help="students' weights (default: the shipped ones)"
    )
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    return parser


def _case(kind: str, seed: int, number: int, num_samples: int) -> tuple[Scene, Travel, Example]:
    """A scene of 10 drones and 20 tasks with near-optimal bundles, or a hard one with random bundles."""
    family = KINDS[kind][number % len(KINDS[kind])]
    scene, is_hard = draw_scene(SceneMix(family, hard_share=float(kind == "hard"), usual_share=1.0), seed)
    travel = compute_travel(scene)
    bundles = random_bundles(scene, seed) if is_hard else refine_bundles(scene, travel=travel, seed=seed)
    return scene, travel, example(scene, bundles.routes, num_samples)


def _trajectory_rows(students: dict[str, Student], base: Example, travel: Travel) -> Iterator[Record]:
    shortest = np.array([travel.route_length(drone, route) for drone, route in enumerate(base.routes)])
    for index, (name, student) in enumerate(students.items()):
        for steps, tries in OTHER_VARIANTS if index else VARIANTS:
            yield {"student": name, "steps": _words(steps), "tries": tries, **_drawn(student, base, shortest, steps, tries)}


def _words(steps: Steps) -> str:
    return "no" if steps == 0 else str(steps) if isinstance(steps, int) else f"{steps[0]}, then {steps[1]}"


def _drawn(student: Student, base: Example, shortest: FloatArray, steps: Steps, tries: int) -> Record:
    """What of a fleet is clear as drawn; ``shortest`` (N,) m."""
    blocked, active = base.is_blocked, base.active
    began = perf_counter()
    samples, clear = base.straight, ~blocked
    if steps:
        (drawing,) = draw(student, [base], steps=steps, tries=tries)
        samples, clear = drawing.samples, drawing.clear
    seconds = perf_counter() - began
    lengths = np.linalg.norm(np.diff(samples, axis=1), axis=-1).sum(axis=1)
    cleared = clear & blocked
    return {
        "scene": base.scene.sha256[:12], "scene_clear": bool(clear[active].all()), "drones": int(active.sum()),
        "drones_clear": int((clear & active).sum()), "blocked": int(blocked.sum()), "blocked_clear": int(cleared.sum()),
        "detour": float((lengths[cleared] / shortest[cleared]).mean() - 1.0) if cleared.any() else float("nan"),
        "seconds": seconds,
    }  # fmt: skip


def _allocation_rows(student: Student, scene: Scene, travel: Travel) -> Iterator[Record]:
    best = refine_bundles(scene, travel=travel, iterations=20_000)
    best_known, owner = travel.total(best.routes), best.assignment(scene.num_tasks).argmax(axis=0)
    began = perf_counter()
    (head,) = task_probabilities(student, collate([example(scene, [()] * scene.num_drones)]))
    head_s = perf_counter() - began
    nearness = np.exp(-straight_travel(scene).start_task / np.median(travel.start_task))
    for name, preferences, seconds in (("head", head, head_s), ("nearness", nearness, 0.0), ("none", None, 0.0)):
        accuracy = float("nan") if preferences is None else float((preferences.argmax(axis=0) == owner).mean())
        for effort, settings in _efforts(seconds):
            began = perf_counter()
            bundles = refine_bundles(scene, preferences, travel=travel, **settings)
            yield {
                "scene": scene.sha256[:12], "preferences": name, "effort": effort, "cost": travel.total(bundles.routes),
                "best_known": best_known, "accuracy": accuracy, "seconds": seconds + perf_counter() - began,
            }  # fmt: skip


def _efforts(spent_s: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """What the refinement is allowed, by name: iterations, or what is left of a budget of time."""
    for iterations in ITERATIONS:
        yield f"{iterations} iterations", {"iterations": iterations}
    for budget_ms in BUDGETS_MS:
        yield f"{budget_ms} ms in all", {"time_limit_s": max(budget_ms / 1e3 - spent_s, 1e-4)}


def _summary(trajectories: list[Record], allocation: list[Record]) -> str:
    table = []
    for kind, student, steps, tries in dict.fromkeys(
        (row["kind"], row["student"], row["steps"], row["tries"]) for row in trajectories
    ):
        key = (kind, student, steps, tries)
        rows = [row for row in trajectories if (row["kind"], row["student"], row["steps"], row["tries"]) == key]
        name = "straight lines" if steps == "no" else f"{student}, {steps} steps, best of {tries}"
        shares = [100.0 * _total(rows, part) / max(_total(rows, whole), 1.0) for part, whole in (
            ("drones_clear", "drones"), ("blocked_clear", "blocked"))]  # fmt: skip
        detours = [float(row["detour"]) for row in rows if np.isfinite(row["detour"])]
        detour = 100.0 * float(np.mean(detours)) if detours else float("nan")
        median, worst = spread([1e3 * float(row["seconds"]) for row in rows])
        clear = 100.0 * float(np.mean([row["scene_clear"] for row in rows]))
        table.append([kind, name, clear, *shares, detour, median, worst])
    columns = ["scenes", "drawn by", "scenes clear %", "drones clear %", "blocked drones clear %", "detour %", "ms", "p95 ms"]
    lines = [header("Student ablation", "benchmarks.student_ablation"), "## Trajectories, before mending\n"]
    lines += [markdown_table(columns, table), "## Allocation, forest\n", _allocation_table(allocation)]
    return "\n".join(lines)


def _allocation_table(records: list[Record]) -> str:
    table = []
    for name, effort in dict.fromkeys((row["preferences"], row["effort"]) for row in records):
        rows = [row for row in records if (row["preferences"], row["effort"]) == (name, effort)]
        over = [100.0 * (float(row["cost"]) / float(row["best_known"]) - 1.0) for row in rows]
        median, _ = spread([1e3 * float(row["seconds"]) for row in rows])
        accuracy = 100.0 * float(np.mean([row["accuracy"] for row in rows]))
        table.append([name, effort, accuracy, float(np.mean(over)), median])
    return markdown_table(["preferences", "effort", "best drone %", "over best known %", "ms"], table)


def _total(rows: list[Record], key: str) -> float:
    return float(sum(row[key] for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
