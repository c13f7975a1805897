"""Valid plans made by hand: drones in lanes of their own, straight from rest to rest, obstacles between the lanes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from flockopt.bundles import Bound
from flockopt.certificate import Certificate, Clause, Cost, Plan
from flockopt.certificate.certificate import CLAUSES
from flockopt.certificate.proof import KINDS, recompute_bound
from flockopt.flights import Curve, Flight, Visit
from flockopt.scene import Bounds, Box, Cylinder, Drone, Scene, Sphere, Task
from flockopt.travel import Travel
from flockopt.travel.travel import straight_travel

__all__ = ["lane_scene", "plan_of_lanes"]

LANE_M, LENGTH_M, HEIGHT_M = 5.0, 20.0, 5.0


def lane_scene(rng: np.random.Generator, *, lanes: int = 4, tasks_a_lane: int = 3) -> Scene:
    """A lane of 5 m for every drone; the last drone has no tasks and stays where it is."""
    drones, tasks, obstacles = [], [], []
    for lane in range(lanes):
        middle = LANE_M * (lane + 0.5)
        end = [None, "start", (10.0, middle, 4.5)][lane % 3] if lane < lanes - 1 else None
        capacity = tasks_a_lane + 1 if lane < lanes - 1 else 0
        drones.append(Drone(f"d{lane}", (1.0, middle, 1.0), capacity, 0.12, 2.0, 4.0, 30.0, end=end))
        shape = rng.uniform(0.2, 0.7)
        where = (float(rng.uniform(2, 18)), LANE_M * lane, float(rng.uniform(1, 4)))
        obstacles.append(
            (
                Box(f"o{lane}", where, (3 * shape, shape, 2 * shape), float(rng.uniform(-0.2, 0.2))),
                Cylinder(f"o{lane}", where, shape, 3.0),
                Sphere(f"o{lane}", where, shape),
            )[int(rng.integers(3))]
        )
        for rank in range(tasks_a_lane if lane < lanes - 1 else 0):
            place = (3.0 + 4.0 * rank + rng.uniform(0, 3), middle + rng.uniform(-0.8, 0.8), rng.uniform(0.5, 4.5))
            service = float(rng.choice([0.0, 1.5]))
            tasks.append(Task(f"t{lane}.{rank}", place, service_time=service))
    bounds = Bounds((0.0, -1.0, 0.0), (LENGTH_M, LANE_M * lanes + 1.0, HEIGHT_M))
    drones[0] = replace(drones[0], max_distance=1.01 * _route_length(drones[0], tasks[:tasks_a_lane]))
    apart = {"separation": 0.4, "separation_z": 0.8} if rng.integers(2) else {}  # without it, bodies count
    return Scene("lanes", bounds, drones, tasks, obstacles, clearance=0.1, **apart)


def _route_length(drone: Drone, tasks: list[Task]) -> float:
    """Metres through the tasks in order, and on to the end."""
    stops = [drone.start, *(task.position for task in tasks), *([drone.end_point] if drone.end_point is not None else [])]
    return sum(math.dist(a, b) for a, b in itertools.pairwise(stops))


def plan_of_lanes(scene: Scene, rng: np.random.Generator, kind: str = "two-ended-forest") -> tuple[Plan, Travel]:
    """Every drone serves the tasks of its lane in order; the proof is a random vector, valid as any is."""
    travel = straight_travel(scene)
    routes, flights = {}, {}
    for drone in scene.drones:
        lane = drone.id[1:]
        mine = [task for task in scene.tasks if task.id.startswith(f"t{lane}.")]
        if mine:
            routes[drone.id] = tuple(task.id for task in mine)
            flights[drone.id] = _fly(drone, mine, float(rng.uniform(0.0, 2.0)))
    proof = Bound(kind, 0.0, rng.uniform(0.0, 0.5, KINDS[kind].length(scene)))
    proof = Bound(kind, recompute_bound(scene, travel, proof), proof.dual)
    numbers = {task.id: index for index, task in enumerate(scene.tasks)}
    total = travel.total([[numbers[task] for task in routes.get(drone.id, ())] for drone in scene.drones])
    cost = Cost(
        length=math.fsum(flight.curve.length for flight in flights.values()),
        travel=total,
        lower_bound=proof.value,
        gap=(total - proof.value) / proof.value,
        makespan=max(flight.curve.end_time for flight in flights.values()),
    )
    claim = Certificate(tuple(Clause(name, True, 0.0, "m") for name in CLAUSES), proof)
    return Plan(scene.name, scene.sha256, "by hand", "certified", routes, {}, flights, cost, claim), travel


def _fly(drone: Drone, tasks: list[Task], start_time: float) -> Flight:
    breakpoints, pieces, visits, here = [start_time], [], [], np.array(drone.start)
    stops = [(np.array(task.position), task) for task in tasks]
    if drone.end_point is not None:
        stops.append((np.array(drone.end_point), None))
    for there, task in stops:
        distance = float(np.linalg.norm(there - here))
        # speed, acceleration and jerk of 10 s^3 - 15 s^4 + 6 s^5 peak at 15/8, 10/sqrt(3) and 60
        span = 1.02 * max(
            15 / 8 * distance / drone.max_speed,
            math.sqrt(10 / math.sqrt(3) * distance / drone.max_acceleration),
            (60 * distance / drone.max_jerk) ** (1 / 3),
        )
        piece = np.zeros((3, 6))
        piece[:, 0] = here
        piece[:, 3:] = (there - here)[:, None] * np.array([10.0, -15.0, 6.0]) / span ** np.arange(3, 6)
        pieces.append(piece)
        breakpoints.append(breakpoints[-1] + span)
        here = there
        if task is not None:
            visits.append(Visit(task.id, breakpoints[-1]))
            if task.service_time > 0.0:
                pieces.append(np.pad(there[:, None], ((0, 0), (0, 5))))
                breakpoints.append(breakpoints[-1] + task.service_time)
    return Flight(Curve(np.array(breakpoints), np.array(pieces)), tuple(visits))
