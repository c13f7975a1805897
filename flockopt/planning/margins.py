"""Room for tracking errors: a scene that asks for more than the scene does, to plan flights in.

A drone strays from its plan by its tracking error e. Flown positions keep the scene's clearance and separation if the plan
keeps e more of the one and 2 e more of the other, as far as the scene leaves that room:

- Each obstacle, and each side of the bounds, comes nearer by e, or by half of what the nearest start, task or end leaves.
- An obstacle in whose narrow gap a way would be closed, or much longer around, stays as it is.
- The separation grows by 2 e, or by half of what the starts leave.

A certificate is always for the scene as it is; this only makes sure that there is something left of it in flight.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.bundles import Bundles
from flockopt.certificate import Certificate
from flockopt.geometry.distances import distances
from flockopt.geometry.kernels import segment_distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Bounds, Box, Cylinder, Obstacle, Scene
from flockopt.scene.apart import least_resting_share
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel
from flockopt.travel.travel import stops_of

__all__ = ["is_enough", "margins", "roomier"]

#: Clauses that no other margin mends: they are about who serves what.
ALLOCATED = ("coverage", "capacity", "bound")

#: Share of the room beside starts, tasks and ends that the margin may take: what is left lets curves pass through them. At one
#: half a grown box, whose corners move outwards by more than its faces, stays clear of them too.
ROOM_SHARE = 0.5

#: A way is much longer if it grows by this share and this many margins.
LONGER_SHARE, LONGER_MARGINS = 0.1, 10.0

#: How often obstacles in narrow gaps are given back their size before the margin is given up.
ROUNDS = 4


def margins(margin_m: float) -> tuple[tuple[float, float], ...]:
    """Margins of clearance and separation, metres, in the order in which they are to be tried; the last pair is none."""
    if margin_m == 0.0:
        return ((0.0, 0.0),)
    return (margin_m, 2.0 * margin_m), (margin_m, 0.0), (0.0, 0.0)


def is_enough(certificate: Certificate) -> bool:
    """Whether a smaller margin would mend nothing of what a certificate finds."""
    return all(clause.name in ALLOCATED for clause in certificate.failed)


def roomier(
    scene: Scene, travel: Travel, bundles: Bundles, clearance_m: float, separation_m: float, deadline: Deadline = NEVER
) -> tuple[Scene, Travel]:
    """A scene that asks for more room, and the ways of the bundles in it.

    Args:
        scene: The scene as it is.
        travel: Its travel.
        bundles: Which drone visits what.
        clearance_m: How much more clearance to ask for, metres.
        separation_m: How much more separation, metres.
        deadline: When to give up.

    Returns:
        The scene and its travel, of which only the bundles' own legs are to be used; what was given where both are 0.
    """
    if clearance_m == 0.0 and separation_m == 0.0:
        return scene, travel
    wide = _farther_apart(scene, separation_m)
    growth = _growth(scene, bundles, clearance_m)
    for _ in range(ROUNDS):
        grown = _grown(wide, growth, clearance_m)
        ways = compute_travel(grown, routes=bundles.routes, deadline=deadline)
        tight = _in_the_way(scene, travel, ways, bundles, growth, clearance_m)
        if not tight.any():
            return grown, ways
        growth[tight] = 0.0
    return wide, travel


def _farther_apart(scene: Scene, separation_m: float) -> Scene:
    """The scene with a larger separation.

    Where it is an ellipsoid, all its axes grow by the same factor: so it holds the old one moved by ``separation_m`` any way.
    """
    if scene.num_drones < 2:
        return scene
    axes = scene.widest_axes
    scaled = scene.starts / axes
    least = min(float(np.linalg.norm(scaled[:i] - scaled[i], axis=1).min()) for i in range(1, len(scaled)))
    least = min(least, least_resting_share(scene))
    factor = 1.0 + min(separation_m / float(axes.min()), ROOM_SHARE * max(least - 1.0, 0.0))
    tall = None if scene.separation_z is None else factor * scene.separation_z
    return scene if factor == 1.0 else scene.replace(separation=factor * float(axes[0]), separation_z=tall)


def _growth(scene: Scene, bundles: Bundles, clearance_m: float) -> FloatArray:
    """By how much each obstacle may grow, (K,) m."""
    places, needs = [scene.task_positions], [np.full(scene.num_tasks, scene.radii.min())]
    for index, route in enumerate(bundles):
        end = scene.ends[index : index + 1]
        own = np.concatenate([scene.starts[index : index + 1], scene.task_positions[list(route)], end[~np.isnan(end[:, 0])]])
        places.append(own)
        needs.append(np.full(len(own), scene.radii[index]))
    gaps = distances(scene.obstacle_table, np.concatenate(places))  # (P, K)
    room = gaps - np.concatenate(needs)[:, None] - scene.clearance
    return np.clip(ROOM_SHARE * room.min(axis=0), 0.0, clearance_m)


def _grown(scene: Scene, growth: FloatArray, clearance_m: float) -> Scene:
    """The scene with each obstacle larger on every side, and its bounds narrower."""
    obstacles = tuple(_larger(obstacle, float(more)) for obstacle, more in zip(scene.obstacles, growth, strict=True))
    places = np.concatenate([scene.task_positions, scene.starts, scene.ends[~np.isnan(scene.ends[:, 0])]])
    lower, upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    lower = lower + np.clip(ROOM_SHARE * (places - lower).min(axis=0), 0.0, clearance_m)
    upper = upper - np.clip(ROOM_SHARE * (upper - places).min(axis=0), 0.0, clearance_m)
    return scene.replace(obstacles=obstacles, bounds=Bounds(tuple(lower.tolist()), tuple(upper.tolist())))


def _larger(obstacle: Obstacle, more: float) -> Obstacle:
    if isinstance(obstacle, Box):
        x, y, z = obstacle.size
        return replace(obstacle, size=(x + 2.0 * more, y + 2.0 * more, z + 2.0 * more))
    if isinstance(obstacle, Cylinder):
        return replace(obstacle, radius=obstacle.radius + more, height=obstacle.height + 2.0 * more)
    return replace(obstacle, radius=obstacle.radius + more)


def _in_the_way(
    scene: Scene, travel: Travel, ways: Travel, bundles: Bundles, growth: FloatArray, clearance_m: float
) -> NDArray[np.bool_]:
    """Which grown obstacles (K,) the scene's own ways enter where the new ones end or are much longer."""
    found = np.zeros(len(growth), dtype=np.bool_)
    for index, route in enumerate(bundles):
        for leg in pairwise(stops_of(scene, index, route)):
            old, new = travel.path(index, *leg), ways.path(index, *leg)
            longest = (1.0 + LONGER_SHARE) * _length(old) + LONGER_MARGINS * clearance_m
            if len(new) == 0 or _length(new) > longest:
                gaps = segment_distances(scene.obstacle_table, old[:-1], old[1:]).min(axis=0)
                found |= gaps < scene.radii[index] + scene.clearance + growth
    return found & (growth > 0.0)


def _length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
