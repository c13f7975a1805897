"""Whether certificates can be refuted: random scenes are planned, and what is certified is sampled ten thousand times a second.

    python -m benchmarks.audit --scenes 1000 --seed 0 --out out/audit

In every scene each optional key is drawn or left out at random. Flights are sampled with formulas of their own, which share no
code with the judge: bodies and separation, clearance, bounds, limits, thrust and tilt, lengths that are flown, loads, starts,
ends and visits. Writes ``audit.csv`` (a row a scene) and ``summary.md``. It fails if a sample refutes a certificate, or a scene
that was accepted is neither certified nor given a reason.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from benchmarks.report import CsvRows, Record, benchmark_parser, header, markdown_table, tell, write_summary
from flockopt import FlockError, Scene, SceneError, plan
from flockopt.certificate import Plan
from flockopt.flights import Curve
from flockopt.records.arrays import FloatArray
from flockopt.scene import Box, Cylinder, Drone, Obstacle

__all__ = ["main", "random_scene", "refutations"]

COLUMNS = ("scene", "seed", "refused", "drones", "tasks", "obstacles", "status", "reason", "refuted", "seconds")

#: Seconds between two samples, and how many are looked at at once.
STEP_S, SAMPLES_AT_ONCE = 1e-4, 20_000

#: What a sample must be off to count, by quantity: the judge's own tolerances and as much again for rounding here.
LENGTH_M, LIMIT_SHARE, VISIT_M = 2e-6, 2e-6, 1.0001e-3

GRAVITY = np.array([0.0, 0.0, 9.80665])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the audit; 0 if no certificate is refuted and every other answer says why."""
    options = _parser().parse_args(argv)
    rows = CsvRows(options.out / "audit.csv", COLUMNS)
    seeds = range(options.seed, options.seed + options.scenes)
    work = Parallel(n_jobs=options.jobs, return_as="generator")(delayed(audited)(seed, options.planner) for seed in seeds)
    for number, record in enumerate(work, start=1):
        rows.add(record)
        tell(f"{number}/{options.scenes} {record['status']:<12}")
    tell("\n")
    rows.close()
    write_summary(options.out, _summary(rows.records))
    faulty = [record for record in rows.records if record["refuted"] or not _is_plain(record)]
    return 1 if faulty else 0


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("audit", __doc__)
    parser.add_argument("--scenes", type=int, default=1000, help="how many (default 1000)")
    parser.add_argument("--planner", default="classical", help="who proposes (default classical)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    return parser


def audited(seed: int, planner: str) -> Record:
    """One scene planned, and its certificate put to the test."""
    rng, refused = np.random.default_rng([seed, 23]), 0
    while True:
        try:
            scene = random_scene(rng)
            break
        except SceneError:
            refused += 1
    record = {
        "scene": scene.sha256[:12], "seed": seed, "refused": refused, "drones": scene.num_drones, "tasks": scene.num_tasks,
        "obstacles": len(scene.obstacles), "refuted": "", "reason": "", "seconds": 0.0,
    }  # fmt: skip
    try:
        flown = plan(scene, planner=planner, seed=seed)
    except FlockError as fault:
        return record | {"status": "error", "reason": str(fault)}
    record |= {"status": str(flown.status), "reason": _reason(flown), "seconds": flown.timing["total"]}
    if flown.status == "certified":
        record["refuted"] = "; ".join(refutations(scene, flown))
    return record


def _reason(flown: Plan) -> str:
    failed = () if flown.certificate is None else flown.certificate.failed
    return "; ".join([*([flown.reason] if flown.reason else []), *(f"{clause.name}: {clause.detail}" for clause in failed)])


def _is_plain(record: Record) -> bool:
    return record["status"] != "error" and (record["status"] == "certified" or bool(record["reason"]))


def random_scene(rng: np.random.Generator) -> Scene:
    """A scene of a few drones, tasks and obstacles in which each optional key is drawn or left out.

    Raises:
        SceneError: Where what was drawn is no valid scene: draw again.
    """
    scale = float(rng.choice([0.5, 1.0, 1.0, 10.0]))
    size = scale * np.array([rng.uniform(6.0, 12.0), rng.uniform(6.0, 12.0), rng.uniform(2.0, 4.0)])
    origin = rng.choice([0.0, 0.0, 5e5]) * np.array([1.0, 8.0, 0.0])
    radius = 0.1 * scale

    def place() -> list[float]:
        return [float(value) for value in origin + rng.uniform(0.05, 0.95, 3) * size]

    def maybe(key: str, draw: Any) -> dict[str, Any]:
        return {key: draw()} if rng.random() < 0.5 else {}

    document = {
        "format": "flockopt.scene/1", "name": "random",
        "bounds": {"lower": origin.tolist(), "upper": (origin + size).tolist()},
        "drones": [_drone(rng, f"d{i}", radius, place, maybe) for i in range(int(rng.integers(1, 7)))],
        "tasks": [
            {"id": f"t{j}", "position": place()}
            | maybe("demand", lambda: int(rng.integers(1, 4)))
            | maybe("service_time", lambda: float(rng.choice([0.0, 0.2, 1.0])))
            for j in range(int(rng.integers(0, 10)))
        ],
        "obstacles": [_obstacle(rng, f"o{k}", scale, size, place) for k in range(int(rng.integers(0, 8)))],
    }  # fmt: skip
    document |= maybe("clearance", lambda: float(rng.uniform(0.0, 0.2)) * scale)
    document |= maybe("separation", lambda: float(rng.uniform(0.0, 0.6)) * scale)
    document |= maybe("separation_z", lambda: float(rng.uniform(2.0 * radius, 8.0 * radius)))
    document |= maybe("origin", lambda: {"latitude": 52.0, "longitude": 4.4, "altitude": 0.0})
    return Scene.from_dict(document)


def _drone(rng: np.random.Generator, name: str, radius: float, place: Any, maybe: Any) -> dict[str, Any]:
    size, speed = radius * float(rng.choice([1.0, 1.0, 1.6])), float(rng.uniform(1.0, 3.0))
    drone = {
        "id": name, "start": place(), "capacity": int(rng.integers(0, 8)), "radius": size, "max_speed": speed,
        "max_acceleration": float(rng.uniform(2.0, 6.0)), "max_jerk": float(rng.uniform(10.0, 40.0)),
    }  # fmt: skip
    drone |= maybe("end", lambda: "start" if rng.random() < 0.5 else place())
    drone |= maybe("max_distance", lambda: float(rng.uniform(40.0, 400.0)) * radius)
    if rng.random() < 0.15:
        drone["velocity"] = (rng.normal(size=3) * 0.2 * speed).tolist()
    if rng.random() < 0.5:
        drone["mass"] = float(rng.uniform(0.03, 1.5))
        drone |= maybe("max_thrust", lambda: drone["mass"] * 9.80665 * float(rng.uniform(1.3, 2.5)))
    drone |= maybe("max_tilt", lambda: float(rng.uniform(0.2, 1.0)))
    return drone


def _obstacle(rng: np.random.Generator, name: str, scale: float, size: FloatArray, place: Any) -> dict[str, Any]:
    shape = {"id": name, "shape": str(rng.choice(["box", "cylinder", "sphere"])), "center": place()}
    if shape["shape"] == "box":
        shape["size"] = (scale * rng.uniform(0.2, 2.0, 3)).tolist()
        return shape | ({"yaw": float(rng.uniform(-3.0, 3.0))} if rng.random() < 0.5 else {})
    shape["radius"] = scale * float(rng.uniform(0.1, 0.8))
    return shape | ({"height": float(size[2] * rng.uniform(0.2, 1.0))} if shape["shape"] == "cylinder" else {})


def refutations(scene: Scene, flown: Plan, step_s: float = STEP_S) -> list[str]:
    """What samples of a plan's flights find wrong, in words; none for a plan that does what its certificate says.

    Args:
        scene: The scene.
        flown: The plan.
        step_s: Seconds between two samples.
    """
    found = dict.fromkeys(_wrong_routes(scene, flown))
    lengths = np.zeros(scene.num_drones)
    last_s = max((flight.curve.end_time for flight in flown.flights.values()), default=0.0)
    count = math.ceil(last_s / step_s) + 2
    for first in range(0, count, SAMPLES_AT_ONCE - 1):
        times: FloatArray = step_s * np.arange(first, min(first + SAMPLES_AT_ONCE, count), dtype=np.float64)
        motion = np.array([_motion(flown, drone, times) for drone in scene.drones])  # (N, 4, T, 3)
        lengths += np.linalg.norm(np.diff(motion[:, 0], axis=1), axis=2).sum(axis=1)
        found |= dict.fromkeys(_wrong_moments(scene, motion))
        found |= dict.fromkeys(_wrong_visits(scene, flown, times, motion))
    for drone, length in zip(scene.drones, lengths, strict=True):
        if drone.max_distance is not None and length > drone.max_distance * (1.0 + LIMIT_SHARE):
            found[f"{drone.id} flies {length:.6g} m"] = None
    return list(found)


def _wrong_routes(scene: Scene, flown: Plan) -> Iterator[str]:
    """Tasks not served once, loads, and flights that do not begin and end as they should."""
    served = [task for route in flown.routes.values() for task in route]
    visited = [visit.task for flight in flown.flights.values() for visit in flight.visits]
    if sorted(served) != sorted(task.id for task in scene.tasks) or sorted(visited) != sorted(served):
        yield "not every task is served once"
    demand = {task.id: task.demand for task in scene.tasks}
    for drone in scene.drones:
        if sum(demand[task] for task in flown.routes.get(drone.id, ())) > drone.capacity:
            yield f"{drone.id} carries too much"
        begin, end = (_motion(flown, drone, np.array([time]))[:3, 0] for time in (0.0, 1e9))
        wanted = np.array([drone.start, drone.velocity, drone.acceleration])
        if np.any(np.linalg.norm(begin - wanted, axis=1) > [LENGTH_M, 2e-4, 2e-2]):
            yield f"{drone.id} does not begin in its start state"
        if drone.end_point is not None and math.dist(end[0], drone.end_point) > VISIT_M:
            yield f"{drone.id} does not come to its end"


def _motion(flown: Plan, drone: Drone, times: FloatArray) -> FloatArray:
    """(4, T, 3): position, velocity, acceleration and jerk; at rest before and after the flight."""
    result = np.zeros((4, len(times), 3))
    if drone.id not in flown.flights:
        result[0] = drone.start
        return result
    curve: Curve = flown.flights[drone.id].curve
    inside = np.clip(times, curve.breakpoints[0], curve.breakpoints[-1])
    piece = np.clip(np.searchsorted(curve.breakpoints, inside, side="right") - 1, 0, len(curve.coefficients) - 1)
    since = (inside - curve.breakpoints[piece])[:, None]
    terms = curve.coefficients[piece]  # (T, 3, D)
    flying = ((times >= curve.breakpoints[0]) & (times <= curve.breakpoints[-1]))[:, None]
    for order in range(4):
        for power in reversed(range(terms.shape[2])):
            result[order] = result[order] * since + terms[..., power]
        terms = terms[..., 1:] * np.arange(1, terms.shape[2])
        if order:
            result[order] *= flying
    return result


def _wrong_moments(scene: Scene, motion: FloatArray) -> Iterator[str]:
    """Limits, bounds, obstacles and other drones, at every sample of motion (N, 4, T, 3)."""
    lower, upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    for drone, (place, *changes) in zip(scene.drones, motion, strict=True):
        for name, change in zip(("max_speed", "max_acceleration", "max_jerk"), changes, strict=True):
            if np.linalg.norm(change, axis=1).max() > getattr(drone, name) * (1.0 + LIMIT_SHARE):
                yield f"{drone.id} breaks its {name}"
        thrust = changes[1] + GRAVITY
        force = (drone.mass or 0.0) * np.linalg.norm(thrust, axis=1).max()
        if drone.max_thrust is not None and force > drone.max_thrust * (1.0 + LIMIT_SHARE):
            yield f"{drone.id} breaks its max_thrust"
        tilt = np.arctan2(np.hypot(thrust[:, 0], thrust[:, 1]), thrust[:, 2]).max()
        if drone.max_tilt is not None and tilt > drone.max_tilt * (1.0 + LIMIT_SHARE):
            yield f"{drone.id} breaks its max_tilt"
        if (place < lower - LENGTH_M).any() or (place > upper + LENGTH_M).any():
            yield f"{drone.id} leaves the bounds"
        for obstacle in scene.obstacles:
            if _gap(obstacle, place).min() < drone.radius + scene.clearance - LENGTH_M:
                yield f"{drone.id} is too near to {obstacle.id}"
    tall = scene.separation if scene.separation_z is None else scene.separation_z
    for i, one in enumerate(scene.drones):
        for j, other in enumerate(scene.drones[:i]):
            away = motion[i, 0] - motion[j, 0]
            if np.linalg.norm(away, axis=1).min() < one.radius + other.radius - LENGTH_M:
                yield f"{one.id} and {other.id} touch"
            if scene.separation > 0.0:
                scaled = np.linalg.norm(away / np.array([scene.separation, scene.separation, tall]), axis=1).min()
                if scaled * scene.separation < scene.separation - LENGTH_M:
                    yield f"{one.id} and {other.id} are nearer than the separation"


def _gap(obstacle: Obstacle, place: FloatArray) -> FloatArray:
    """(T,) m from places (T, 3) to an obstacle's surface, not above 0 inside."""
    away = place - np.array(obstacle.center)
    if isinstance(obstacle, Box):
        cos, sin = math.cos(obstacle.yaw), math.sin(obstacle.yaw)
        turned = np.column_stack([cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0], away[:, 2]])
        return np.asarray(np.linalg.norm(np.maximum(np.abs(turned) - 0.5 * np.array(obstacle.size), 0.0), axis=1))
    if isinstance(obstacle, Cylinder):
        sideways = np.hypot(away[:, 0], away[:, 1]) - obstacle.radius
        return np.hypot(np.maximum(sideways, 0.0), np.maximum(np.abs(away[:, 2]) - 0.5 * obstacle.height, 0.0))
    return np.asarray(np.linalg.norm(away, axis=1) - obstacle.radius)


def _wrong_visits(scene: Scene, flown: Plan, times: FloatArray, motion: FloatArray) -> Iterator[str]:
    """Tasks whose drone is elsewhere while it should serve them."""
    tasks = {task.id: task for task in scene.tasks}
    for place, drone in zip(motion[:, 0], scene.drones, strict=True):
        for visit in flown.flights[drone.id].visits if drone.id in flown.flights else ():
            task = tasks[visit.task]
            during = (times >= visit.time) & (times <= visit.time + task.service_time)
            moment = _motion(flown, drone, np.array([visit.time]))[0]
            seen = np.concatenate([place[during], moment])
            if np.linalg.norm(seen - np.array(task.position), axis=1).max() > VISIT_M:
                yield f"{drone.id} is not at {task.id} while it serves it"


def _summary(records: list[Record]) -> str:
    rows = []
    for status in sorted({record["status"] for record in records}):
        group = [record for record in records if record["status"] == status]
        refuted = sum(bool(record["refuted"]) for record in group)
        rows.append([status, len(group), refuted, sum(not _is_plain(record) for record in group)])
    refused = sum(record["refused"] for record in records)
    faults = [f"- seed {record['seed']}: {record['refuted']}" for record in records if record["refuted"]]
    others = [f"- seed {record['seed']}, {record['status']}: {record['reason'][:300]}" for record in records
              if record["status"] != "certified"]  # fmt: skip
    return "\n".join(
        [
            header("Audit of certificates", "benchmarks.audit"), f"{refused} drawn scenes were refused as malformed.\n",
            markdown_table(["status", "scenes", "refuted", "without a reason"], rows), *faults, "", *others, "",
        ]
    )  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
