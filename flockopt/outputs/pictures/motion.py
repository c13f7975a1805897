"""A plan's motion, sampled for drawing. Proofs are `flockopt.certify`'s business, not this module's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flockopt.errors import PlanError
from flockopt.flights import Flight
from flockopt.geometry.distances import distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

if TYPE_CHECKING:
    from flockopt.certificate import Plan

__all__ = ["SampledMotion", "flights_of", "sample_motion"]

#: How many instants a drawing shows, and how many drone-obstacle and drone-drone distances it may take.
MOST_INSTANTS, LEAST_INSTANTS, DISTANCE_BUDGET = 600, 80, 10_000_000

#: Points whose distances are taken at once, so that memory stays small in big scenes.
CHUNK_DISTANCES = 1_000_000


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """Where everyone is when, and how near the nearest pair and the nearest obstacle are.

    Attributes:
        times: (T,) s, from 0 to a little after the last drone has finished.
        positions: (N, T, 3) m.
        separation: (T,) m, least distance between two drones' centres, scaled so that what is required of every pair, in
            every direction, is ``scene.widest_axes[0]``; infinite for one drone.
        clearance: (T,) m, least gap between a drone's body and an obstacle; infinite with no obstacles.
    """

    times: FloatArray  # (T,) s
    positions: FloatArray  # (N, T, 3) m
    separation: FloatArray  # (T,) m
    clearance: FloatArray  # (T,) m


def flights_of(scene: Scene, plan: Plan | None) -> dict[int, Flight]:
    """The plan's flights by drone index; a drone that the scene does not know is the judge's business.

    Raises:
        PlanError: If a flight leaves all that can be drawn.
    """
    flights = {} if plan is None else plan.flights
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = [flight.curve.length for flight in flights.values()]
    for number, length in enumerate(lengths):
        if not math.isfinite(length):
            seen, rule = "are so large that positions overflow", "must describe a flight of finite length"
            raise PlanError(f"trajectories[{number}].coefficients", seen, rule, "verify the plan before drawing it")
    return {index: flights[drone.id] for index, drone in enumerate(scene.drones) if drone.id in flights}


def sample_motion(scene: Scene, plan: Plan | None) -> SampledMotion | None:
    """The motion of all drones, those that never move included; None where nobody moves."""
    flights = flights_of(scene, plan)
    if not flights:
        return None
    makespan = max(flight.curve.end_time for flight in flights.values())
    num_distances = scene.num_drones * max(1, len(scene.obstacles), scene.num_drones)
    num_instants = int(np.clip(DISTANCE_BUDGET // num_distances, LEAST_INSTANTS, MOST_INSTANTS))
    times = np.linspace(0.0, 1.02 * makespan, num_instants)
    positions = np.repeat(scene.starts[:, None], num_instants, axis=1)  # (N, T, 3)
    for index, flight in flights.items():
        positions[index] = flight.curve(times)
    return SampledMotion(times, positions, _least_separation(scene, positions), _least_clearance(scene, positions))


def _least_separation(scene: Scene, positions: FloatArray) -> FloatArray:
    """(T,) m, each pair's distance measured by what the two must keep: as if all had to keep `Scene.widest_axes`."""
    least = np.full(positions.shape[1], np.inf)
    if len(positions) < 2:
        return least
    first, second = np.triu_indices(len(positions), 1)
    axes = scene.axes_between(first, second) / scene.widest_axes[0]  # (P, 3)
    for instant, points in enumerate(np.swapaxes(positions, 0, 1)):  # (N, 3)
        least[instant] = np.linalg.norm((points[first] - points[second]) / axes, axis=1).min()
    return least


def _least_clearance(scene: Scene, positions: FloatArray) -> FloatArray:
    num_drones, num_instants, _ = positions.shape
    table = scene.obstacle_table
    if not len(table):
        return np.full(num_instants, np.inf)
    points = positions.reshape(-1, 3)
    gaps = np.empty(len(points))
    step = max(1, CHUNK_DISTANCES // len(table))
    for first in range(0, len(points), step):
        gaps[first : first + step] = distances(table, points[first : first + step]).min(axis=1)
    return np.min(gaps.reshape(num_drones, num_instants) - scene.radii[:, None], axis=0)
