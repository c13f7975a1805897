"""Public multi-depot open routing instances: our search beside PyVRP's and OR-Tools' published costs.

    python -m benchmarks.public_instances --data benchmarks/data/mdovrp-val-50.npz --out out/public-50

Each file holds 128 instances: three depots with unlimited identical vehicles, customers with demands, open routes
in the unit square. A depot's vehicles become enough drones. Writes ``public_instances.csv`` (a row an instance) and
``summary.md``. One thread an instance; the first, a warm-up, is solved twice.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, tell, write_summary
from flockopt import Bounds, Drone, Scene, SettingsError, Task, refine_bundles
from flockopt.cli.status import run_command
from flockopt.records.arrays import FloatArray
from flockopt.travel import Travel
from flockopt.travel.travel import straight_travel

__all__ = ["Instances", "main"]

COLUMNS = ("instance", "method", "seconds", "cost", "pyvrp_cost", "ortools_cost")
NUM_DEPOTS = 3
FIELDS = ("locations", "demands", "capacity", "depots", "pyvrp_cost", "ortools_cost")

#: Bodies do not overlap, so a depot's drones stand on top of each other, a hair apart.
RADIUS_M, APART_M = 1e-6, 3e-6

#: Drones at each depot, as a multiple of the vehicles that the total demand takes: more than any good solution uses.
DRONES_PER_NEED = 2


@dataclass(frozen=True)
class Instances:
    """The instances of one file.

    Attributes:
        locations: (B, 3 + n, 2), the depots first.
        demands: (B, n).
        capacity: Of every vehicle.
        pyvrp_cost: (B,) published.
        ortools_cost: (B,) published.
    """

    locations: FloatArray
    demands: FloatArray
    capacity: int
    pyvrp_cost: FloatArray
    ortools_cost: FloatArray

    @classmethod
    def load(cls, path: Path) -> Instances:
        """Read a file, without executing anything in it.

        Raises:
            SettingsError: If it is not a file of instances, naming what is missing.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                fields = {name: data[name] for name in FIELDS}
        except (OSError, ValueError, KeyError) as fault:
            rule = f"must be an .npz file with {', '.join(FIELDS)}"
            raise SettingsError("data", f"{path} cannot be read ({fault})", rule, "name such a file") from None
        if int(fields.pop("depots")) != NUM_DEPOTS:
            raise SettingsError("data", f"{path} has other depots", f"must have {NUM_DEPOTS}", "name another file")
        return cls(**fields | {"capacity": int(fields["capacity"])})

    def __len__(self) -> int:
        return len(self.locations)

    def scene(self, index: int) -> Scene:
        """An instance as a scene in the plane; a depot's vehicles are drones that start on one spot."""
        places = np.column_stack([self.locations[index].astype(np.float64), np.zeros(self.locations.shape[1])])
        demands = self.demands[index].astype(int)
        fleet = DRONES_PER_NEED * -(-int(demands.sum()) // self.capacity)
        speed, acceleration, jerk = 1.0, 1.0, 1.0
        drones = [
            Drone(f"depot-{depot}-{k}", (x, y, APART_M * k), self.capacity, RADIUS_M, speed, acceleration, jerk)
            for depot, (x, y, _) in enumerate(places[:NUM_DEPOTS].tolist())
            for k in range(fleet)
        ]
        tasks = [Task(f"t{j}", tuple(place), int(demands[j])) for j, place in enumerate(places[NUM_DEPOTS:])]
        return Scene(f"mdovrp-{index}", Bounds((-1, -1, -1), (2, 2, 1)), tuple(drones), tuple(tasks))


def _from_depots(travel: Travel) -> Travel:
    """The travel of vehicles that all set off at their depot: as of its first drone, which stands right there."""
    fleet = len(travel.start_task) // NUM_DEPOTS
    return replace(travel, start_task=np.repeat(travel.start_task[::fleet], fleet, axis=0))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 if every instance is served whole."""
    options = _parser().parse_args(argv)
    return run_command("benchmarks.public_instances", lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    instances = Instances.load(options.data)
    rows = CsvRows(options.out / "public_instances.csv", COLUMNS)
    count = min(options.instances or len(instances), len(instances))
    _solve(instances, 0, options)
    for index in range(count):
        rows.add(_solve(instances, index, options))
        tell(f"{index + 1}/{count}")
    tell("\n")
    rows.close()
    means = {key: float(np.mean([record[key] for record in rows.records])) for key in COLUMNS[2:]}
    table = [
        [f"flockopt {options.method}", means["cost"], means["seconds"]],
        ["PyVRP, published", means["pyvrp_cost"], "-"],
        ["OR-Tools, published", means["ortools_cost"], "-"],
    ]
    better = sum(record["cost"] < record["pyvrp_cost"] - 1e-6 for record in rows.records)
    worse = sum(record["cost"] > record["pyvrp_cost"] + 1e-6 for record in rows.records)
    note = f"{count} instances of {options.data.name}: better than PyVRP's cost in {better}, worse in {worse}.\n\n"
    columns = ["method", "mean cost", "mean seconds"]
    write_summary(
        options.out, header("Public instances", "benchmarks.public_instances") + "\n" + note + markdown_table(columns, table)
    )
    return 0 if np.isfinite(means["cost"]) else 1


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("public_instances", __doc__)
    parser.add_argument("--data", type=Path, required=True, help="an .npz file, such as benchmarks/data/mdovrp-val-50.npz")
    parser.add_argument("--method", default="search", help="of refine_bundles (default search)")
    parser.add_argument("--seconds", type=float, default=1.0, help="time limit for each instance (default 1)")
    parser.add_argument("--instances", type=int, default=None, help="how many, from the first (default all)")
    return parser


def _solve(instances: Instances, index: int, options: argparse.Namespace) -> Record:
    """Solve one instance; its cost is recomputed from the distances and the routes, served tasks counted."""
    scene = instances.scene(index)
    travel = _from_depots(straight_travel(scene))
    began = perf_counter()
    bundles = refine_bundles(scene, travel=travel, method=options.method, time_limit_s=options.seconds, seed=options.seed)
    seconds = perf_counter() - began
    whole = sorted(task for route in bundles for task in route) == list(range(scene.num_tasks))
    return {
        "instance": index, "method": options.method, "seconds": seconds,
        "cost": travel.total(bundles.routes) if whole else float("inf"),
        "pyvrp_cost": float(instances.pyvrp_cost[index]), "ortools_cost": float(instances.ortools_cost[index]),
    }  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
