"""How long finding ways takes, how long the ways are, and how both grow.

    python -m benchmarks.travel --scenes 10 --seed 0 --pairs 2000 --out out/travel

Every family of scenes and both city blocks, with 10 drones and 40 tasks. ``seconds`` is all pairs of places from nothing,
``cpu_s`` its processor time, ``again_s`` the same when ten tasks are elsewhere and what was learnt of the obstacles is still
known. Lengths of at least ``--pairs`` pairs that bend are compared with two references:

- ``reference``: shortest ways over the same places to bend, by a dense visibility graph in which every line is checked and
  scipy's Dijkstra. No way may be longer.
- ``fine``: the same search with many more places to bend, pulled taut; or ours, whichever is shorter. Ours may be longer, as a
  way may lead around other obstacles than the best one does.

``growth.csv`` has the times of city scenes as obstacles grow from 10 to 1,000 with 200 places, and as places grow from 50 to
2,000 among 153 buildings. Writes ``travel.csv`` (a row a scene), ``growth.csv``, ``summary.md`` and ``travel.png``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, spread, tell, write_summary
from flockopt import Scene, generate
from flockopt.geometry.free_space import free_space
from flockopt.records.arrays import FloatArray
from flockopt.scene.families.layouts import FAMILIES
from flockopt.scene.merging import with_merged_obstacles
from flockopt.travel import bends, roadmap
from flockopt.travel.compute import MARGIN_SHARE, compute_travel
from flockopt.travel.legs import Legs
from flockopt.travel.roadmap import Roadmap
from flockopt.travel.surroundings import blocked_between, surroundings, uneased
from flockopt.travel.travel import places

__all__ = ["main", "reference_lengths"]

EXAMPLES = Path(__file__).parents[1] / "examples" / "scenes"
CITIES = ("rotterdam", "delft")

#: Drones, tasks, and how many tasks are elsewhere when ways are found again.
DRONES, TASKS, MOVED = 10, 40, 10

#: Samples of the fine reference: on a stretch of edge, and for how large a share of the space's longest side there is one.
FINE_SAMPLES, FINE_SHARE = 12, 1.0 / 60.0

#: A way that is longer than the reference by this share is too long.
TOO_LONG = 1e-3

OBSTACLES, PLACES = (10, 30, 100, 300, 1000), (50, 100, 200, 500, 1000, 2000)
#: Places while obstacles grow, buildings while places grow.
FEW_PLACES, BUILDINGS = 200, 153

COLUMNS = (
    "family", "scene", "obstacles", "places", "seconds", "cpu_s", "again_s", "pairs", "longest", "too_long", "mean_fine",
    "longest_fine", "straight",
)  # fmt: skip
GROWTH_COLUMNS = ("obstacles", "places", "seconds", "cpu_s", "again_s")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; the exit status is 1 if some way is longer than the reference by more than `TOO_LONG`."""
    arguments = _parser().parse_args(argv)
    rows, growth = CsvRows(arguments.out / "travel.csv", COLUMNS), CsvRows(arguments.out / "growth.csv", GROWTH_COLUMNS)
    for family in arguments.families:
        for scene in _scenes(family, arguments):
            rows.add(_measured(family, scene))
            tell(f"{family}: {scene.name}")
            if sum(row["pairs"] for row in rows.records if row["family"] == family) >= arguments.pairs:
                break
    for obstacles, count in _sizes(arguments.most):
        tell(f"growth: {obstacles} obstacles, {count} places")
        growth.add(_grown(obstacles, count, arguments.seed))
    tell("\n")
    write_summary(arguments.out, _summary(rows.records, growth.records))
    _draw(growth.records, arguments.out / "travel.png")
    rows.close()
    growth.close()
    return int(any(row["too_long"] for row in rows.records))


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("travel", __doc__)
    parser.add_argument("--scenes", type=int, default=10, help="of each family, at most (default 10)")
    parser.add_argument("--pairs", type=int, default=2000, help="that bend, of each family, then no more scenes (default 2000)")
    parser.add_argument("--families", nargs="+", default=[*FAMILIES, *CITIES], help="some of the families and city blocks")
    parser.add_argument("--most", type=int, default=2000, help="obstacles or places while they grow (default 2000)")
    return parser


def _scenes(family: str, arguments: argparse.Namespace) -> Iterator[Scene]:
    if family in CITIES:
        yield Scene.load(EXAMPLES / f"{family}.json")
        return
    for seed in range(arguments.seed, arguments.seed + arguments.scenes):
        yield generate(family, drones=DRONES, tasks=TASKS, seed=seed)


def _sizes(most: int) -> Iterator[tuple[int, int]]:
    for obstacles in OBSTACLES:
        if obstacles <= most:
            yield obstacles, FEW_PLACES
    for count in PLACES:
        if count <= most:
            yield BUILDINGS, count


def _timed(scene: Scene, moved: Scene) -> Record:
    """Ways of a scene from nothing, and of the scene with tasks elsewhere after that."""
    compute_travel(scene)  # loads compiled code
    roadmap._roadmap.cache_clear()
    cpu, wall = process_time(), perf_counter()
    compute_travel(scene)
    seconds, cpu_s = perf_counter() - wall, process_time() - cpu
    wall = perf_counter()
    compute_travel(moved)
    return {"seconds": seconds, "cpu_s": cpu_s, "again_s": perf_counter() - wall}


def _elsewhere(scene: Scene) -> Scene:
    """The scene with some tasks a little elsewhere: where others are, a hand higher."""
    tasks = list(scene.tasks)
    for index in range(min(MOVED, len(tasks))):
        x, y, z = tasks[index].position
        tasks[index] = replace(tasks[index], position=(x, y, z + 0.01))
    return scene.replace(tasks=tuple(tasks))


def _measured(family: str, scene: Scene) -> Record:
    record = _timed(scene, _elsewhere(scene))
    merged = with_merged_obstacles(scene)
    need = float(scene.radii.max()) + scene.clearance
    where = places(merged)
    where = np.ascontiguousarray(where[~np.isnan(where).any(axis=1)])
    ours, reference = _ways(merged, need, where), reference_lengths(merged, need, where)
    fine_ways = _fine_ways(merged, need, where)
    first, second = ours.pairs.T
    lengths = ours.lengths[first, second]
    ratio, fine = lengths / reference[first, second], lengths / np.minimum(lengths, fine_ways.lengths[first, second])
    away = np.linalg.norm(where[first] - where[second], axis=1)
    return record | {
        "family": family, "scene": scene.name, "obstacles": len(merged.obstacles), "places": len(where), "pairs": len(first),
        "longest": float(ratio.max(initial=1.0)), "too_long": int((ratio > 1.0 + TOO_LONG).sum()),
        "mean_fine": float(fine.mean()) if len(fine) else 1.0, "longest_fine": float(fine.max(initial=1.0)),
        "straight": float((lengths / away).mean()) if len(away) else 1.0,
    }  # fmt: skip


def _roadmap_of(scene: Scene, need: float) -> Roadmap:
    return Roadmap(scene.obstacle_table, need, (scene.bounds.lower, scene.bounds.upper), MARGIN_SHARE * need)


def _ways(scene: Scene, need: float, where: FloatArray) -> Legs:
    return _roadmap_of(scene, need).legs(where, np.ones((len(where), len(where)), dtype=np.bool_))


def _fine_ways(scene: Scene, need: float, where: FloatArray) -> Legs:
    coarse = bends.MOST_SAMPLES, bends.SPACING_SHARE
    try:
        bends.MOST_SAMPLES, bends.SPACING_SHARE = FINE_SAMPLES, FINE_SHARE
        return _ways(scene, need, where)
    finally:
        bends.MOST_SAMPLES, bends.SPACING_SHARE = coarse


def reference_lengths(scene: Scene, need: float, where: FloatArray) -> FloatArray:
    """(P, P) m: shortest ways between places (P, 3) over a dense visibility graph of where ours may bend."""
    space = free_space(scene.obstacle_table, (1.0 + MARGIN_SHARE) * need, (scene.bounds.lower, scene.bounds.upper))
    nodes = np.ascontiguousarray(np.vstack([where, bends.make_features(space).position]))
    around, none = surroundings(space), uneased(len(nodes))
    edges, weights = [], []
    for node in range(len(nodes) - 1):
        pairs = np.stack([np.full(len(nodes) - node - 1, node), np.arange(node + 1, len(nodes))], axis=1)
        pairs = pairs[~blocked_between(around, none, nodes, pairs)]
        edges.append(pairs)
        weights.append(np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1))
    first, second = np.concatenate(edges).T
    graph = csr_matrix((np.concatenate(weights), (first, second)), shape=(len(nodes), len(nodes)))
    return np.asarray(dijkstra(graph, directed=False, indices=np.arange(len(where)))[:, : len(where)])


def _grown(obstacles: int, count: int, seed: int) -> Record:
    side = 4.0 * float(np.sqrt(max(obstacles * 7.2, count)))  # as dense as the family's own
    drones = max(count // 11, 1)
    scene = generate(
        "city",
        drones=drones,
        tasks=count - drones,
        seed=seed,
        obstacles=obstacles,
        size=(max(side, 20.0), max(side, 20.0), 5.0),
    )
    return {"obstacles": obstacles, "places": count} | _timed(scene, _elsewhere(scene))


def _summary(records: Sequence[Record], growth: Sequence[Record]) -> str:
    lines = []
    for family in dict.fromkeys(row["family"] for row in records):
        rows = [row for row in records if row["family"] == family]
        pairs = np.array([row["pairs"] for row in rows])
        lines.append((
            family, len(rows), f"{np.mean([row['obstacles'] for row in rows]):.0f}",
            *(1e3 * spread([row[name] for row in rows])[0] for name in ("seconds", "cpu_s", "again_s")), int(pairs.sum()),
            f"{max(row['longest'] for row in rows):.5f}", sum(row["too_long"] for row in rows),
            f"{np.average([row['mean_fine'] for row in rows], weights=np.maximum(pairs, 1)):.5f}",
            f"{np.average([row['straight'] for row in rows], weights=np.maximum(pairs, 1)):.4f}",
        ))  # fmt: skip
    columns = (
        "family", "scenes", "obstacles", "ms", "cpu ms", "again ms", "pairs", "longest / reference", "too long", "mean / fine",
        "mean / straight",
    )  # fmt: skip
    more = markdown_table(GROWTH_COLUMNS, [[row[name] for name in GROWTH_COLUMNS] for row in growth])
    return f"{header('Ways among obstacles', 'benchmarks.travel')}\n{markdown_table(columns, lines)}\n{more}"


def _draw(growth: Sequence[Record], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, name, other in zip(figure.subplots(1, 2), ("obstacles", "places"), ("places", "obstacles"), strict=True):
        fixed = FEW_PLACES if name == "obstacles" else BUILDINGS
        rows = sorted((row for row in growth if row[other] == fixed), key=itemgetter(name))
        for column, words in (("seconds", "from nothing"), ("again_s", "obstacles known")):
            axes.loglog([row[name] for row in rows], [row[column] for row in rows], "o-", label=words)
        axes.set(xlabel=f"{name}, with {fixed} {other}", ylabel="seconds for all pairs")
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    raise SystemExit(main())
