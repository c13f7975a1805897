"""How fast and how well a flying fleet is replanned when tasks and drones come and go.

    python -m benchmarks.replanning --events 1000 --seed 0 --out out/replanning

Flies certified plans and strikes them with seeded events: nothing at all, a task added, one removed, a drone lost, or all of
it at once; each flight takes several, each replanned from the plan before. ``--families delft`` flies a city block. Writes
``replanning.csv`` (a row an event), ``summary.md`` and ``replanning.png``. `cost_ratio` is the travel of the new bundles over
that of a long search from the same situation with nothing to be kept; `churn` is the share of open tasks that change drones.
`seconds` pass on the clock, `cpu_seconds` are those of the processor, which other work on the machine disturbs less.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.planning import CITIES, PlanningCase
from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import Changes, Scene, Task, compute_travel, plan, refine_bundles, replan
from flockopt.certificate import Plan
from flockopt.planning.replan import FREEZE_S, Replanned
from flockopt.scene.families.layouts import FAMILIES
from sim.mission.events import random_task

__all__ = ["main"]

COLUMNS = (
    "scene", "family", "seed", "event", "kind", "time", "status", "strategy", "open", "served", "unserved",
    "churn", "cost", "scratch_cost", "cost_ratio", "seconds", "cpu_seconds", "plan_seconds",
)  # fmt: skip
KINDS = ("none", "added", "removed", "lost", "mixed")

#: Events that strike one flight before another scene is taken.
EVENTS_A_FLIGHT = 4

#: Iterations of the search that has nothing to keep and no hurry.
SCRATCH_ITERATIONS = 40_000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if every event ends in a certified plan."""
    options = _parser().parse_args(argv)
    rows = CsvRows(options.out / "replanning.csv", COLUMNS)
    list(_events(options, options.families[0], 1))  # a warm-up that does not count
    share = -(-options.events // len(options.families))
    for family in options.families:
        for record in _events(options, family, min(share, options.events)):
            rows.add(record)
            tell(f"{len(rows.records)}/{share * len(options.families)} {family:<10}")
    tell("\n")
    rows.close()
    write_summary(options.out, _summary(rows.records))
    _plot(rows.records, options.out / "replanning.png")
    return 0 if all(record["status"] == "certified" for record in rows.records) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("replanning", __doc__)
    parser.add_argument("--events", type=int, default=1000, help="events in all (default 1000)")
    parser.add_argument("--drones", type=int, default=10, help="drones a scene (default 10)")
    parser.add_argument("--tasks", type=int, default=20, help="tasks a scene (default 20)")
    parser.add_argument(
        "--tracking-margin", type=float, default=0.0, metavar="M", help="room for tracking errors, metres (default 0)"
    )
    parser.add_argument(
        "--families", nargs="+", default=list(FAMILIES), choices=[*FAMILIES, *CITIES], help="scenes (default all)"
    )
    return parser


def _events(options: argparse.Namespace, family: str, count: int) -> Iterator[Record]:
    """CsvRows of ``count`` events that strike flights through scenes of one family."""
    seed, margin_m = options.seed, options.tracking_margin
    while count > 0:
        case = PlanningCase(family, options.drones, options.tasks, seed)
        scene = case.scene()
        flying, rng = plan(scene, planner="classical", seed=seed, tracking_margin_m=margin_m), np.random.default_rng([seed, 7])
        for event in range(min(EVENTS_A_FLIGHT, count)):
            kind = KINDS[int(rng.integers(len(KINDS)))]
            changes = _changes(scene, kind, f"{seed}-{event}", rng)
            now_s = float(rng.uniform(0.0, 0.7) * flying.cost.makespan)
            cpu = time.process_time()
            answer = replan(scene, flying, now_s, changes, seed=seed, tracking_margin_m=margin_m)
            cpu_s = time.process_time() - cpu
            head = {"scene": scene.sha256[:12], "family": family, "seed": seed, "event": event, "kind": kind, "time": now_s}
            times = {"seconds": answer.seconds, "cpu_seconds": cpu_s, "plan_seconds": flying.timing.get("total", np.nan)}
            yield head | _measures(flying, answer) | times
            count -= 1
            if answer.plan.status != "certified" or not answer.scene.num_tasks:
                break
            scene, flying = answer.scene, replace(answer.plan, timing=flying.timing)
        seed += 1


def _changes(scene: Scene, kind: str, name: str, rng: np.random.Generator) -> Changes:
    added: tuple[Task, ...] = ()
    removed: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    if kind in ("added", "mixed"):
        task = random_task(scene, f"new-{name}", rng)
        added = () if task is None else (task,)
    if kind in ("removed", "mixed") and scene.num_tasks:
        removed = (scene.tasks[int(rng.integers(scene.num_tasks))].id,)
    if kind in ("lost", "mixed") and scene.num_drones > 2:
        lost = (scene.drones[int(rng.integers(scene.num_drones))].id,)
    return Changes(added, removed, lost)


def _measures(old: Plan, answer: Replanned) -> Record:
    """What an answer changes and what it costs."""
    owner = {task: drone for drone, route in old.routes.items() for task in route}
    now = {task: drone for drone, route in answer.plan.routes.items() for task in route}
    both = [task for task in now if task in owner]
    scratch = refine_bundles(answer.scene, travel=(travel := compute_travel(answer.scene)), iterations=SCRATCH_ITERATIONS)
    best = travel.total(scratch.routes)
    return {
        "status": answer.plan.status, "strategy": answer.strategy, "open": len(now) + len(answer.unserved),
        "served": len(now), "unserved": len(answer.unserved),
        "churn": sum(now[task] != owner[task] for task in both) / max(len(both), 1),
        "cost": answer.plan.cost.travel, "scratch_cost": best,
        "cost_ratio": answer.plan.cost.travel / best if best > 0.0 else 1.0,
    }  # fmt: skip


def _summary(records: list[Record]) -> str:
    table = []
    for family in dict.fromkeys(record["family"] for record in records):
        group = [record for record in records if record["family"] == family]
        certified = sum(record["status"] == "certified" for record in group)
        times = (value for key in ("seconds", "cpu_seconds") for value in spread([record[key] * 1e3 for record in group]))
        strategies = [sum(record["strategy"] == name for record in group) for name in ("new", "old", "appended", "kept")]
        unserved = sum(record["unserved"] for record in group)
        ratio, churn = (float(np.mean([record[key] for record in group])) for key in ("cost_ratio", "churn"))
        table.append([family, f"{certified}/{len(group)}", *times, *strategies, unserved, churn, ratio])
    columns = ["scenes", "certified", "p50 ms", "p95 ms", "p50 CPU ms", "p95 CPU ms", "new", "old", "appended", "kept"]
    columns += ["unserved", "churn", "cost ratio"]
    kinds = [
        [family, kind, *_by_kind(records, family, kind)]
        for family in dict.fromkeys(r["family"] for r in records)
        for kind in KINDS
    ]
    heads = [
        "scenes",
        "event",
        "events",
        "p50 ms",
        "p95 ms",
        f"over the freeze of {FREEZE_S * 1e3:g} ms",
        "of the first plan's time",
    ]
    note = "New to kept: how the certified plan came about. Unserved tasks are listed with their reason in each answer.\n\n"
    return (
        header("Replanning", "benchmarks.replanning")
        + "\n"
        + note
        + markdown_table(columns, table)
        + "\n"
        + markdown_table(heads, kinds)
    )


def _by_kind(records: list[Record], family: str, kind: str) -> list[object]:
    group = [record for record in records if (record["family"], record["kind"]) == (family, kind)]
    seconds = [record["seconds"] for record in group]
    late = sum(second > FREEZE_S for second in seconds)
    shares = [record["seconds"] / record["plan_seconds"] for record in group if record["plan_seconds"] > 0.0]
    return [len(group), *spread([second * 1e3 for second in seconds]), late, spread(shares)[0]]


def _plot(records: list[Record], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for family in dict.fromkeys(record["family"] for record in records):
        seconds = np.sort([record["seconds"] * 1e3 for record in records if record["family"] == family])
        axes.plot(seconds, np.arange(1, len(seconds) + 1) / len(seconds), label=family)
    axes.set_xscale("log")
    axes.set_xlabel("milliseconds to a certified plan")
    axes.set_ylabel("share of events")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
