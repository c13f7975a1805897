"""How punctual planning is: plans under time limits, and plans that are interrupted from the keyboard.

    python -m benchmarks.deadlines --scenes 50 --seed 0 --out out/deadlines

Scenes grow from 2 x 4 to 100 x 1000, through the five families. Each is planned under every limit; late is what a plan takes
beyond it, and it may be a tenth of the limit and 0.2 s. Then the command line is interrupted (Ctrl-C) at moments spread over
its work: it should end within a second, with exit status 130 and nothing half-written. Writes ``limits.csv``,
``interrupts.csv`` and ``summary.md``.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import Scene, generate, plan
from flockopt.certificate import Plan
from flockopt.errors import PlanError
from flockopt.scene.families.layouts import FAMILIES

__all__ = ["main"]

LIMIT_COLUMNS = ("scene", "drones", "tasks", "limit_s", "status", "seconds", "late_s", "is_punctual", "gap", "reason")
INTERRUPT_COLUMNS = ("scene", "planner", "after_s", "status", "seconds", "is_clean")
LIMITS_S = (0.1, 0.3, 1.0, 3.0, 10.0)

#: Sizes of the scenes, drones x tasks, taken in turn.
SIZES = ((2, 4), (4, 9), (10, 20), (10, 40), (20, 100), (30, 200), (50, 400), (100, 1000))

#: Late by this share of the limit, and by so many seconds, is punctual; an interrupted command ends within so many.
LATE_SHARE, LATE_S, END_S = 0.1, 0.2, 1.0

INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if every plan is punctual and every interrupt is obeyed."""
    options = _parser().parse_args(argv)
    limits = CsvRows(options.out / "limits.csv", LIMIT_COLUMNS)
    scenes = [_scene(number, options.seed) for number in range(options.scenes)]
    plan(scenes[0], planner=options.planner, time_limit_s=5.0)  # a warm-up that does not count
    for number, scene in enumerate(scenes, start=1):
        for limit_s in options.limits:
            tell(f"{number}/{len(scenes)} {scene.name:<22} {limit_s:g} s ")
            limits.add(_limited(scene, options.planner, limit_s))
    limits.close()
    interrupts = CsvRows(options.out / "interrupts.csv", INTERRUPT_COLUMNS)
    for record in _interrupts(options) if options.interrupts else ():
        tell(f"interrupted {record['scene']:<22} after {record['after_s']:.2f} s ")
        interrupts.add(record)
    tell("\n")
    interrupts.close()
    write_summary(options.out, _summary(limits.records, interrupts.records))
    punctual = all(record["is_punctual"] for record in limits.records)
    return 0 if punctual and all(record["is_clean"] for record in interrupts.records) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("deadlines", __doc__)
    parser.add_argument("--scenes", type=int, default=50, help="how many (default 50)")
    parser.add_argument("--planner", default="classical", help="who proposes (default classical)")
    parser.add_argument("--limits", type=float, nargs="+", default=list(LIMITS_S), metavar="S", help="seconds")
    parser.add_argument("--interrupts", type=int, default=10, help="interrupts a planner and scene; 0 for none (default 10)")
    return parser


def _scene(number: int, seed: int) -> Scene:
    drones, tasks = SIZES[number % len(SIZES)]
    return generate(tuple(FAMILIES)[number % len(FAMILIES)], drones=drones, tasks=tasks, seed=seed + number)


def _limited(scene: Scene, planner: str, limit_s: float) -> Record:
    began = time.perf_counter()
    made = plan(scene, planner=planner, time_limit_s=limit_s)
    seconds = time.perf_counter() - began
    return {
        "scene": scene.name, "drones": scene.num_drones, "tasks": scene.num_tasks, "limit_s": limit_s, "status": made.status,
        "seconds": seconds, "late_s": max(seconds - limit_s, 0.0), "gap": made.cost.gap, "reason": made.reason,
        "is_punctual": seconds <= (1.0 + LATE_SHARE) * limit_s + LATE_S,
    }  # fmt: skip


#: Planners that are interrupted, with the family and size of their scene: each has its own long stage.
INTERRUPTED_CASES = (
    ("classical", "rooms", 40, 400), ("classical", "forest", 20, 100), ("exact", "forest", 10, 40),
    ("ortools", "forest", 10, 40),
)  # fmt: skip


def _interrupts(options: argparse.Namespace) -> Iterator[Record]:
    rng = np.random.default_rng([options.seed, 31])
    for planner, family, drones, tasks in INTERRUPTED_CASES:
        with tempfile.TemporaryDirectory() as folder:
            scene, target = Path(folder) / "scene.json", Path(folder) / "plan.json"
            generate(family, drones=drones, tasks=tasks, seed=options.seed).save(scene)
            command = [sys.executable, "-m", "flockopt", "plan", str(scene), "-o", str(target), "--planner", planner]
            began = time.perf_counter()
            subprocess.run(command, capture_output=True, check=False)
            whole_s = time.perf_counter() - began
            for after_s in np.sort(rng.uniform(0.3, whole_s, options.interrupts)):
                target.unlink(missing_ok=True)
                yield {"scene": f"{family}-{drones}x{tasks}", "planner": planner} | _interrupted(
                    command, float(after_s), target
                )


def _interrupted(command: list[str], after_s: float, target: Path) -> Record:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    time.sleep(after_s)
    began = time.perf_counter()
    process.send_signal(signal.SIGINT)
    _, words = process.communicate()
    seconds = time.perf_counter() - began
    ended = process.returncode in (0, INTERRUPTED, -signal.SIGINT)  # by the signal itself where Python begins or ends
    clean = ended and "Traceback" not in words and seconds <= END_S and _is_whole(target)
    return {"after_s": after_s, "status": process.returncode, "seconds": seconds, "is_clean": clean}


def _is_whole(target: Path) -> bool:
    """Whether there is nothing but a whole plan, or nothing at all."""
    try:
        return not list(target.parent.glob("*.tmp*")) and (not target.exists() or Plan.load(target) is not None)
    except PlanError:
        return False


def _summary(limits: list[Record], interrupts: list[Record]) -> str:
    table = []
    for limit_s in dict.fromkeys(record["limit_s"] for record in limits):
        group = [record for record in limits if record["limit_s"] == limit_s]
        certified = sum(record["status"] == "certified" for record in group)
        unfinished = sum(record["reason"].startswith("out of time") for record in group)
        late, punctual = [record["late_s"] for record in group], sum(record["is_punctual"] for record in group)
        table.append([limit_s, len(group), certified, unfinished, punctual, *spread(late), max(late)])
    columns = ["limit, s", "plans", "certified", "unfinished", "punctual", "late p50, s", "p95", "most"]
    rows = []
    for planner, scene in dict.fromkeys((record["planner"], record["scene"]) for record in interrupts):
        group = [record for record in interrupts if (record["planner"], record["scene"]) == (planner, scene)]
        seconds = [record["seconds"] for record in group]
        rows.append([planner, scene, len(group), sum(record["is_clean"] for record in group), *spread(seconds), max(seconds)])
    heads = ["planner", "scene", "interrupts", "obeyed", "seconds p50", "p95", "most"]
    parts = [header("Deadlines", "benchmarks.deadlines"), markdown_table(columns, table)]
    return "\n".join([*parts, *([markdown_table(heads, rows)] if rows else [])])


if __name__ == "__main__":
    raise SystemExit(main())
