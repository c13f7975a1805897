"""What each part of the student is worth, on forests with near-optimal bundles and on hard scenes.

    python -m benchmarks.student_ablation --scenes 100 --seed 0 --out out/student-ablation

Trajectories: how often scenes, drones and blocked drones (those with a leg whose straight line is not clear) are clear
before any mending, by DDIM steps and tries, beside plain straight lines; and how much longer the clear ways of blocked
drones are than the shortest ones. Allocation: what refinement makes of the head's probabilities, of none and of
nearness, by iterations. Writes ``trajectories.csv``, ``allocation.csv`` (a row a scene and variant) and ``summary.md``.
Scenes are not those that the shipped weights were trained on. The first scene is a warm-up and not counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from benchmarks.report import Rows, header, markdown_table, spread, write_summary
from flockopt import Scene, refine_bundles
from flockopt.travel import Travel, compute_travel, straight_travel
from learned.demonstration_scenes import SceneMix, draw_scene, random_bundles
from learned.student.batch import collate
from learned.student.checkpoint import load_student
from learned.student.examples import Example, example
from learned.student.inference import draw, task_probabilities
from learned.student.model import Student
from learned.student.planner import WEIGHTS

__all__ = ["main"]

#: Added to the seeds, so that no scene is one of the demonstrations, whose seeds start at 0.
UNSEEN = 50_000_000

#: DDIM steps and tries; 0 steps are the straight lines.
VARIANTS = ((0, 1), (1, 1), (2, 1), (5, 1), (2, 4), (2, 16), (2, 64))

ITERATIONS = (0, 20, 100, 1000)
KINDS = ("forest", "hard")

TRAJECTORY_COLUMNS = (
    "scene", "kind", "seed", "steps", "tries", "scene_clear", "drones", "drones_clear", "blocked", "blocked_clear",
    "detour", "seconds",
)  # fmt: skip
ALLOCATION_COLUMNS = ("scene", "seed", "preferences", "iterations", "cost", "best_known", "accuracy", "seconds")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    student = load_student(options.weights)
    trajectories = Rows(options.out / "trajectories.csv", TRAJECTORY_COLUMNS)
    allocation = Rows(options.out / "allocation.csv", ALLOCATION_COLUMNS)
    for kind in KINDS:
        for number in range(-1, options.scenes):
            scene, travel, base = _case(kind, UNSEEN + options.seed + number, student.settings.num_samples)
            for record in _trajectory_rows(student, base, travel):
                if number >= 0:
                    trajectories.add({"kind": kind, "seed": options.seed + number, **record})
            if kind == "forest":
                for record in _allocation_rows(student, scene, travel):
                    if number >= 0:
                        allocation.add({"seed": options.seed + number, **record})
    trajectories.close()
    allocation.close()
    write_summary(options.out, _summary(trajectories.records, allocation.records))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.student_ablation", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenes", type=int, default=100, help="of each kind (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="the first seed (default 0)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="a student's weights (default: the shipped ones)")
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    return parser


def _case(kind: str, seed: int, num_samples: int) -> tuple[Scene, Travel, Example]:
    """A forest of 10 drones and 20 tasks with near-optimal bundles, or a hard one with random bundles."""
    scene, is_hard = draw_scene(SceneMix("forest", hard_share=float(kind == "hard"), usual_share=1.0), seed)
    travel = compute_travel(scene)
    bundles = random_bundles(scene, seed) if is_hard else refine_bundles(scene, travel=travel, seed=seed)
    return scene, travel, example(scene, bundles.routes, num_samples)


def _trajectory_rows(student: Student, base: Example, travel: Travel) -> Iterator[dict[str, object]]:
    blocked, active = base.blocked.any(axis=1), base.active
    shortest = np.array([travel.route_length(drone, route) for drone, route in enumerate(base.routes)])
    for steps, tries in VARIANTS:
        began = perf_counter()
        samples, clear = base.straight, ~blocked
        if steps:
            (drawing,) = draw(student, [base], steps=steps, tries=tries)
            samples, clear = drawing.samples, drawing.clear
        seconds = perf_counter() - began
        lengths = np.linalg.norm(np.diff(samples, axis=1), axis=-1).sum(axis=1)
        cleared = clear & blocked
        yield {
            "scene": base.scene.sha256[:12], "steps": steps, "tries": tries, "scene_clear": bool(clear[active].all()),
            "drones": int(active.sum()), "drones_clear": int((clear & active).sum()), "blocked": int(blocked.sum()),
            "blocked_clear": int(cleared.sum()), "seconds": seconds,
            "detour": float((lengths[cleared] / shortest[cleared]).mean() - 1.0) if cleared.any() else float("nan"),
        }  # fmt: skip


def _allocation_rows(student: Student, scene: Scene, travel: Travel) -> Iterator[dict[str, object]]:
    best = refine_bundles(scene, travel=travel, iterations=20_000)
    best_known, owner = travel.total(best.routes), best.assignment(scene.num_tasks).argmax(axis=0)
    began = perf_counter()
    (head,) = task_probabilities(student, collate([example(scene, [()] * scene.num_drones)]))
    head_s = perf_counter() - began
    nearness = np.exp(-straight_travel(scene).start_task / np.median(travel.start_task))
    for name, preferences, seconds in (("head", head, head_s), ("nearness", nearness, 0.0), ("none", None, 0.0)):
        accuracy = float("nan") if preferences is None else float((preferences.argmax(axis=0) == owner).mean())
        for iterations in ITERATIONS:
            began = perf_counter()
            bundles = refine_bundles(scene, preferences, travel=travel, iterations=iterations)
            yield {
                "scene": scene.sha256[:12], "preferences": name, "iterations": iterations,
                "cost": travel.total(bundles.routes), "best_known": best_known, "accuracy": accuracy,
                "seconds": seconds + perf_counter() - began,
            }  # fmt: skip


def _summary(trajectories: list[dict[str, object]], allocation: list[dict[str, object]]) -> str:
    table = []
    for kind in KINDS:
        for steps, tries in VARIANTS:
            rows = [row for row in trajectories if (row["kind"], row["steps"], row["tries"]) == (kind, steps, tries)]
            name = "straight lines" if not steps else f"{steps} steps, best of {tries}"
            shares = [100.0 * _total(rows, part) / max(_total(rows, whole), 1.0) for part, whole in (
                ("drones_clear", "drones"), ("blocked_clear", "blocked"))]  # fmt: skip
            detours = [float(row["detour"]) for row in rows if np.isfinite(row["detour"])]  # type: ignore[arg-type]
            detour = 100.0 * float(np.mean(detours)) if detours else float("nan")
            median, worst = spread([1e3 * float(row["seconds"]) for row in rows])  # type: ignore[arg-type]
            table.append(
                [kind, name, 100.0 * float(np.mean([row["scene_clear"] for row in rows])), *shares, detour, median, worst]
            )
    columns = ["scenes", "drawn by", "scenes clear %", "drones clear %", "blocked drones clear %", "detour %", "ms", "p95 ms"]
    lines = [header("Student ablation", "benchmarks.student_ablation"), "## Trajectories, before mending\n"]
    lines += [markdown_table(columns, table), "## Allocation, forest\n", _allocation_table(allocation)]
    return "\n".join(lines)


def _allocation_table(records: list[dict[str, object]]) -> str:
    table = []
    for name in dict.fromkeys(str(row["preferences"]) for row in records):
        for iterations in ITERATIONS:
            rows = [row for row in records if (row["preferences"], row["iterations"]) == (name, iterations)]
            over = [100.0 * (float(row["cost"]) / float(row["best_known"]) - 1.0) for row in rows]  # type: ignore[arg-type]
            median, _ = spread([1e3 * float(row["seconds"]) for row in rows])  # type: ignore[arg-type]
            accuracy = 100.0 * float(np.mean([row["accuracy"] for row in rows]))  # type: ignore[arg-type]
            table.append([name, iterations, accuracy, float(np.mean(over)), median])
    return markdown_table(["preferences", "iterations", "best drone %", "over best known %", "ms"], table)


def _total(rows: list[dict[str, object]], key: str) -> float:
    return float(sum(row[key] for row in rows))  # type: ignore[misc]


if __name__ == "__main__":
    raise SystemExit(main())
