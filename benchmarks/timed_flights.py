"""Timed flights: what the network proposes against what CasADi makes of the closed form, and CasADi begun with the proposals.

    python -m benchmarks.timed_flights --scenes 100 --seed 0 --out out/timed-flights

Four ways to the flights of one fleet on the same bundles: the closed form as decoded; the network's proposals where they
hold; CasADi from the closed form; CasADi from the accepted proposals, and from the raw ones where none was accepted. All are
then kept apart and certified. A fleet is certified at once if every drone that moves flies a proposal as it was made and
nothing fails; "in part" counts proposals that were gone only part of the way to. Cost is 0.75 duration + 0.25 squared
jerk as shares of the closed form's, a mean over the drones that move. Writes ``timed_flights.csv`` (a row a scene and way),
``summary.md`` and ``timed_flights.png``. Seconds are those of making flights of flights; every way is gone twice on a
scene and timed the second time, so that no program is built in it; the first scene of each family is a warm-up.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TypeVar

import numpy as np
import torch

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import Scene, compute_travel, decode, generate, refine_bundles
from flockopt.bundles import Bundles
from flockopt.flights import Flight
from flockopt.flights.smoothing.improve import MOTIONLESS, SMOOTHED
from flockopt.flights.smoothing.proposals import Proposed, fly_proposals
from flockopt.flights.smoothing.smooth import Smoothed, smooth_each
from flockopt.flights.smoothing.stages import squared_jerk
from flockopt.planning.finish import GivenFlights, finish
from flockopt.records.status import Status
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel import Travel
from learned.smoother.smoother import WEIGHTS, NetworkProposer, shipped_timed

__all__ = ["main"]

#: Added to the seeds, so that no scene is one that something was trained on.
UNSEEN = 90_000_000

CLOSED, NETWORK, CASADI, WARM = "closed form", "network", "CasADi", "CasADi from the network"
COLUMNS = (
    "family", "scene", "seed", "way", "moving", "at_once", "in_part", "certified", "status", "all_at_once", "all_in_part",
    "makespan_s", "cost", "jerk", "iterations", "seconds",
)  # fmt: skip


@dataclass(frozen=True)
class DecodedFleet:
    """A scene with its bundles and its closed-form flights."""

    scene: Scene
    travel: Travel
    bundles: Bundles
    flights: dict[str, Flight]

    @classmethod
    def of(cls, family: str, drones: int, tasks: int, seed: int) -> DecodedFleet:
        """The case of a generated scene, with near-optimal bundles."""
        scene = generate(family, drones=drones, tasks=tasks, seed=seed)
        travel = compute_travel(scene)
        bundles = refine_bundles(scene, travel=travel, seed=seed)
        return cls(scene, travel, bundles, decode(scene, bundles, travel=travel))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if every fleet is certified in the end."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(1)
    proposer = NetworkProposer(shipped_timed(options.weights))
    rows = CsvRows(options.out / "timed_flights.csv", COLUMNS)
    for number in range(-min(len(FAMILIES), options.scenes), options.scenes):
        family = tuple(FAMILIES)[number % len(FAMILIES)]
        case = DecodedFleet.of(family, options.drones, options.tasks, UNSEEN + options.seed + number)
        for record in _records(case, proposer):
            if number >= 0:
                head = {"family": family, "scene": case.scene.sha256[:12], "seed": options.seed + number}
                rows.add(head | record)
        tell(f"{max(number + 1, 0)}/{options.scenes}")
    tell("\n")
    rows.close()
    write_summary(options.out, _summary(rows.records))
    _picture(rows.records, options.out / "timed_flights.png")
    return 0 if all(row["certified"] for row in rows.records) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("timed_flights", __doc__)
    parser.add_argument("--scenes", type=int, default=100, help="of all families in turn (default 100)")
    parser.add_argument("--drones", type=int, default=10, help="of each scene (default 10)")
    parser.add_argument("--tasks", type=int, default=20, help="of each scene (default 20)")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="of a network (default: the shipped ones)")
    return parser


Flown = TypeVar("Flown", Proposed, Smoothed)


def _timed(go: Callable[[], dict[str, Flown]]) -> tuple[dict[str, Flown], float]:
    """What a function gives when it is called again, and seconds."""
    go()
    began = perf_counter()
    return go(), perf_counter() - began


def _records(case: DecodedFleet, proposer: NetworkProposer) -> list[Record]:
    """A row for each way."""
    scene, flights = case.scene, case.flights
    proposed, proposed_s = _timed(lambda: fly_proposals(scene, flights, proposer))
    starts = {name: each.flight if each.status == SMOOTHED else each.raw for name, each in proposed.items()}
    cold, cold_s = _timed(lambda: smooth_each(scene, flights))
    warm, warm_s = _timed(lambda: smooth_each(scene, flights, starts=starts))
    unchanged = {name: Smoothed(flight, 1.0, 1.0, 0, 0.0, "unchanged") for name, flight in flights.items()}
    moving = [name for name, each in cold.items() if each.status != MOTIONLESS]
    ways: tuple[tuple[str, Mapping[str, Proposed | Smoothed], float], ...] = (
        (CLOSED, unchanged, 0.0),
        (NETWORK, proposed, proposed_s),
        (CASADI, cold, cold_s),
        (WARM, warm, proposed_s + warm_s),
    )
    return [_record(case, way, reports, moving, seconds) for way, reports, seconds in ways]


def _record(
    case: DecodedFleet, way: str, reports: Mapping[str, Proposed | Smoothed], moving: list[str], seconds: float
) -> Record:
    chosen = {name: each.flight for name, each in reports.items()}
    made = finish(case.scene, case.travel, case.bundles, GivenFlights(chosen), planner="search")
    certified = made.status == Status.CERTIFIED
    at_once = [getattr(reports[name], "at_once", False) for name in moving]
    in_part = [way == NETWORK and reports[name].status == SMOOTHED for name in moving]
    return {
        "way": way, "moving": len(moving), "at_once": sum(at_once), "in_part": sum(in_part), "certified": certified,
        "status": made.status, "all_at_once": certified and all(at_once),
        "all_in_part": certified and all(in_part), "makespan_s": made.cost.makespan,
        "cost": float(np.mean([reports[name].cost_after / reports[name].cost_before for name in moving])),
        "jerk": sum(map(_jerk, chosen.values())) / sum(map(_jerk, case.flights.values())),
        "iterations": sum(getattr(each, "iterations", 0) for each in reports.values()), "seconds": seconds,
    }  # fmt: skip


def _jerk(flight: Flight) -> float:
    return squared_jerk(flight.curve.breakpoints, flight.curve.coefficients)


def _column(records: list[Record], way: str, name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in records if row["way"] == way])


def _summary(records: list[Record]) -> str:
    table = []
    for way in (CLOSED, NETWORK, CASADI, WARM):
        column = {name: _column(records, way, name) for name in COLUMNS[4:8] + COLUMNS[9:]}
        milliseconds, worst = spread(1e3 * column["seconds"])
        shorter = column["makespan_s"] / _column(records, CLOSED, "makespan_s")
        proposed = [100.0 * column[name].mean() if way == NETWORK else "" for name in ("all_at_once", "all_in_part")]
        drones = [
            100.0 * column[name].sum() / column["moving"].sum() if way == NETWORK else "" for name in ("at_once", "in_part")
        ]
        table.append(
            [way, *proposed, *drones, 100.0 * column["certified"].mean(), *(100.0 * (np.median(x) - 1.0) for x in (
                shorter, column["cost"], column["jerk"])), np.median(column["iterations"]), milliseconds, worst]
        )  # fmt: skip
    columns = [
        "flights", "fleets at once %", "in part %", "drones at once %", "in part %", "certified %", "makespan %", "cost %",
        "squared jerk %", "iterations", "ms", "p95 ms",
    ]  # fmt: skip
    lines = [header("Timed flights", "benchmarks.timed_flights"), markdown_table(columns, table), _ratios(records)]
    return "\n".join(lines)


def _ratios(records: list[Record]) -> str:
    """Ratios scene by scene, by family and for all."""
    table = []
    for family in (*dict.fromkeys(str(row["family"]) for row in records), "all"):
        rows = [row for row in records if family in (row["family"], "all")]
        iterations, seconds, cost = (
            {way: _column(rows, way, name) for way in (NETWORK, CASADI, WARM)} for name in ("iterations", "seconds", "cost")
        )
        gain = (1.0 - cost[NETWORK]).mean() / (1.0 - cost[CASADI]).mean()
        table.append([
            family, len(cost[CASADI]), 100.0 * _column(rows, NETWORK, "all_at_once").mean(), 100.0 * gain,
            float(np.median(iterations[WARM] / iterations[CASADI].clip(min=1.0))),
            float(np.median(seconds[WARM] / seconds[CASADI])),
            float(np.median(seconds[CASADI] / seconds[NETWORK])), float(np.median(cost[WARM] / cost[CASADI])),
        ])  # fmt: skip
    columns = [
        "family", "scenes", "fleets at once %", "share of CasADi's gain %", "iterations, from the network / closed form",
        "seconds, the same", "seconds, CasADi / network", "cost, CasADi from the network / CasADi",
    ]  # fmt: skip
    return "Gain is the fall in cost; other ratios are medians of those of single scenes.\n\n" + markdown_table(columns, table)


def _picture(records: list[Record], path: Path) -> None:
    """Cost over milliseconds, a dot a scene."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for way in (NETWORK, CASADI, WARM):
        axes.scatter(1e3 * _column(records, way, "seconds"), _column(records, way, "cost"), s=14, label=way, alpha=0.7)
    axes.set(xscale="log", xlabel="ms a fleet", ylabel="cost as a share of the closed form's")
    axes.legend()
    FigureCanvasAgg(figure).print_png(path)


if __name__ == "__main__":
    raise SystemExit(main())
