"""Laws side by side on the same bundles: how fast, how smooth and how clear the flights are, and what they cost to make.

    python -m benchmarks.trajectories --scenes 40 --seed 0 --out out/trajectories

Writes ``trajectories.csv`` (a row a scene and law), ``summary.md`` and ``trajectories.png``, the speed and the jerk of
one drone over time. Scenes take turns through the families. Flights are measured as each law makes them; then they
are kept apart as in a plan, and what fails after that counts as a failure.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.flight_measures import clearance_margin, limit_margins, makespan, separation_margin, squared_jerk, visit_error
from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import Bundles, FlockError, Scene, compute_travel, generate, refine_bundles, smooth
from flockopt.flights import Flight
from flockopt.flights import decode as decoding
from flockopt.flights.apart.deconflict import deconflict
from flockopt.flights.laws.quintic import decode_quintic
from flockopt.flights.waypoints import waypoints_from_paths
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel import Travel

__all__ = ["LAWS", "main"]

Maker = Callable[[Scene, Bundles, Travel], dict[str, Flight]]


def _law(name: str) -> Maker:
    return lambda scene, bundles, travel: decoding.decode(scene, bundles, travel=travel, law=name)


def _smoothed(scene: Scene, bundles: Bundles, travel: Travel) -> dict[str, Flight]:
    """Fly-through, then smoothed with CasADi; both count for the time."""
    return smooth(scene, decoding.decode(scene, bundles, travel=travel, law=REFERENCE))


#: What the others are compared with.
REFERENCE = "fly-through"

#: What is compared, by name; everything else here works for any maker of flights.
LAWS: dict[str, Maker] = {name: _law(name) for name in decoding.LAWS} | {"smooth": _smoothed}

COLUMNS = (
    "scene", "family", "seed", "law", "status", "failed", "makespan", "bound", "ratio", "drone_ratio", "length",
    "squared_jerk", "speed_margin", "acceleration_margin", "jerk_margin", "clearance_margin", "separation_margin",
    "visit_error", "fit_error", "most_pieces", "decode_s", "makespan_apart", "separation_margin_apart", "unresolved",
)  # fmt: skip

#: The best of so many runs counts as a law's time.
REPEATS = 3

#: Margins below this are failures, metres or fractions of a limit; and how far a visit may be off.
SLACK, VISIT_M = 1e-6, 1e-3


@dataclass(frozen=True)
class BundledScene:
    """A scene with its bundles, which all laws fly."""

    family: str
    seed: int
    scene: Scene
    travel: Travel
    bundles: Bundles

    @classmethod
    def make(cls, family: str, seed: int, drones: int, tasks: int) -> BundledScene:
        """A family's scene of a seed, its bundles refined."""
        scene = generate(family, drones=drones, tasks=tasks, seed=seed)
        travel = compute_travel(scene)
        return cls(family, seed, scene, travel, refine_bundles(scene, travel=travel, seed=seed))

    def bounds(self) -> dict[str, float]:
        """For each drone that moves the time no flight along its way can beat by much, seconds.

        Its way at full speed, one ramp up to it (half of that is lost at either end), and its service times.
        """
        result = {}
        for index, (drone, route) in enumerate(zip(self.scene.drones, self.bundles, strict=True)):
            length = self.travel.route_length(index, route)
            if length > 0.0:
                service_s = sum(self.scene.tasks[task].service_time for task in route)
                result[drone.id] = length / drone.max_speed + drone.max_speed / drone.flyable_acceleration + service_s
        return result


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if no law failed anywhere."""
    options = _parser().parse_args(argv)
    rows, shown = CsvRows(options.out / "trajectories.csv", COLUMNS), None
    drones, tasks = (int(part) for part in options.size.split("x"))
    for number in range(options.scenes):
        family = list(FAMILIES)[number % len(FAMILIES)]
        case = BundledScene.make(family, options.seed + number // len(FAMILIES), drones, tasks)
        if shown is None:
            shown = case
            for law in options.laws:
                LAWS[law](case.scene, case.bundles, case.travel)  # warm-up
        for law in options.laws:
            rows.add(run(case, law))
        tell(f"{number + 1}/{options.scenes} {family:<10}")
    tell("\n")
    rows.close()
    write_summary(options.out, _summary(rows.records, options.laws))
    if shown is not None:
        _plot(shown, options.laws, options.out / "trajectories.png")
    return 0 if all(record["status"] == "ok" for record in rows.records) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("trajectories", __doc__)
    parser.add_argument("--scenes", type=int, default=40, help="how many, in turn from each family (default 40)")
    parser.add_argument("--size", default="10x20", help="drones x tasks (default 10x20)")
    parser.add_argument("--laws", nargs="+", default=list(LAWS), choices=list(LAWS), help="what to compare (default all)")
    return parser


def run(case: BundledScene, law: str) -> Record:
    """Fly one scene by one law and describe the flights as a row."""
    record: Record = {"scene": case.scene.sha256[:12], "family": case.family, "seed": case.seed, "law": law}
    times = []
    try:
        for _ in range(REPEATS):
            began = perf_counter()
            flights = LAWS[law](case.scene, case.bundles, case.travel)
            times.append(perf_counter() - began)
        apart = deconflict(case.scene, case.bundles, flights, travel=case.travel)
    except FlockError as fault:
        return record | {"status": "error", "failed": str(fault)}
    bounds = case.bounds()
    slowest_s, bound = makespan(flights), max(bounds.values(), default=0.0)
    record |= {
        "makespan": slowest_s, "bound": bound, "ratio": slowest_s / bound,
        "drone_ratio": float(np.mean([flights[name].curve.end_time / bound for name, bound in bounds.items()])),
        "length": sum(flight.curve.length for flight in flights.values()),
        "squared_jerk": sum(squared_jerk(flight.curve) for flight in flights.values()),
        **limit_margins(case.scene, flights),
        "clearance_margin": clearance_margin(case.scene, flights),
        "separation_margin": separation_margin(case.scene, flights),
        "visit_error": visit_error(case.scene, flights),
        "fit_error": _fit_error(case) if law == "quintic" else None,
        "most_pieces": max(flight.curve.num_pieces for flight in flights.values()),
        "decode_s": min(times), "makespan_apart": makespan(apart.flights),
        "separation_margin_apart": separation_margin(case.scene, apart.flights), "unresolved": len(apart.unresolved),
    }  # fmt: skip
    failed = [key for key in record if "_margin" in key and key != "separation_margin" and not record[key] >= -SLACK]
    failed += ["visit_error"] if not record["visit_error"] <= VISIT_M else []
    return record | {"status": "failed" if failed else "ok", "failed": " ".join(failed)}


def _fit_error(case: BundledScene) -> float:
    """How far the quintic law's pieces are from its spline at most, metres."""
    ways = {i: waypoints_from_paths(case.scene, case.travel, i, route) for i, route in enumerate(case.bundles)}
    return max(decode_quintic(case.scene, {i: way for i, way in ways.items() if way.moves}).fit_error_m.values())


def _by_law(records: list[Record], laws: Sequence[str]) -> Iterator[tuple[str, list[Record]]]:
    for law in laws:
        yield law, [record for record in records if record["law"] == law and record["status"] != "error"]


def _summary(records: list[Record], laws: Sequence[str]) -> str:
    makespans = {(r["scene"], r["law"]): r["makespan"] for r in records if r["status"] != "error"}
    table, families = [], []
    for law, done in _by_law(records, laws):
        versus = [r["makespan"] / makespans[r["scene"], REFERENCE] for r in done if (r["scene"], REFERENCE) in makespans]
        ok = sum(r["status"] == "ok" for r in done)
        means = [_mean(done, key) for key in ("makespan", "ratio", "drone_ratio", "length", "squared_jerk", "makespan_apart")]
        margins = [min(r[key] for r in done) for key in COLUMNS if "margin" in key and not key.endswith("_apart")]
        milliseconds = spread([1e3 * r["decode_s"] for r in done])
        pieces = max(r["most_pieces"] for r in done)
        share = f"{ok}/{sum(r['law'] == law for r in records)}"
        table.append([law, share, means[0], float(np.mean(versus or [np.nan])), *means[1:], *margins, pieces, *milliseconds])
        ratios = [_mean([r for r in done if r["family"] == family], "ratio") for family in FAMILIES]
        families.append([law, *ratios, max(r["ratio"] for r in done)])
    columns = ["law", "ok", "makespan s", f"/ {REFERENCE}", "/ bound", "drone / bound", "length m", "jerk² m²/s⁵", "apart s"]
    columns += ["speed", "acceleration", "jerk", "clearance m", "separation m", "most pieces", "ms", "p95 ms"]
    note = (
        "Means over scenes; margins are the worst of all (limits as fractions of themselves, separation before drones are "
        "kept apart, makespan after that under 'apart'). Ratios are taken scene by scene. The bound of a drone is its way at "
        "full speed plus one acceleration ramp. Times are for the whole fleet, without travel.\n\n"
    )
    text = header("Trajectories", "benchmarks.trajectories") + "\n" + note + markdown_table(columns, table)
    text += "\nMakespan / bound by family:\n\n" + markdown_table(["law", *FAMILIES, "worst"], families)
    text += _fly_through_against_quintic(makespans)
    errors = [r["fit_error"] for r in records if r.get("fit_error") is not None]
    if errors:
        median, worst = float(np.median(errors)), max(errors)
        text += (
            f"\nThe quintic law's pieces are at most {1e3 * worst:.1f} mm from its spline (median scene {1e3 * median:.1f}).\n"
        )
    failures = [
        f"- {r['family']} seed {r['seed']} {r['law']}: {r['status']} {r['failed']}" for r in records if r["status"] != "ok"
    ]
    return text + "\n" + "\n".join(failures)


def _fly_through_against_quintic(makespans: Mapping[tuple[str, str], float]) -> str:
    pairs = [
        (value, makespans[scene, "quintic"])
        for (scene, law), value in makespans.items()
        if law == REFERENCE and (scene, "quintic") in makespans
    ]
    if not pairs:
        return ""
    saved = [1.0 - fast / slow for fast, slow in pairs]
    return (
        f"\nFly-through makespans are {100 * np.mean(saved):.0f} % below the quintic law's (least {100 * min(saved):.0f} %).\n"
    )


def _mean(records: list[Record], key: str) -> float:
    return float(np.mean([record[key] for record in records])) if records else float("nan")


def _plot(case: BundledScene, laws: Sequence[str], path: Path) -> None:
    """Speed and jerk over time of the drone that flies longest, by law."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    bounds = case.bounds()
    name = max(bounds, key=lambda drone: bounds[drone])
    drone = next(record for record in case.scene.drones if record.id == name)
    for law in laws:
        curve = LAWS[law](case.scene, case.bundles, case.travel)[name].curve
        times = np.linspace(0.0, curve.end_time, 2000)
        for axes, order in zip(panels, (1, 3), strict=True):
            axes.plot(times, np.linalg.norm(curve(times, order), axis=1), label=law, linewidth=1.2)
    for axes, limit, title in zip(panels, (drone.max_speed, drone.max_jerk), ("speed, m/s", "jerk, m/s³"), strict=True):
        axes.axhline(limit, color="0.6", linestyle=":", linewidth=1)
        axes.set_ylabel(title)
    panels[1].set_xlabel(f"seconds; drone {name} of {case.scene.name}")
    panels[0].legend(frameon=False, ncols=len(laws))
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
