"""The second judge: least clearance and separation of a plan by FCL's distances, apart from the closed forms.

Conservative advancement: from a distance at one moment and a bound on the motion towards the obstacle follows for how
long nothing can happen (Mirtich, "Impulse-based dynamic simulation", 1996; Zhang et al., "C2A", 2009). Here it goes
both ways from the middle of a stretch of time, and the stretch that can still hold the least distance is looked at
first. Distance to a convex shape is a convex function of the place, so it is never less than the distance at the middle
plus the way back along the direction of the nearest point, which is a polynomial.

Only unsigned distances of a point are asked of FCL, with new request and result objects each time: its signed
distances are off by millimetres, its continuous collision misses hits, and a result that is used again goes stale. A drone
that is inside an obstacle therefore counts as being at distance 0 from it.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from flockopt.certificate.case import RESOLUTION_M, Nearest
from flockopt.certificate.motion_slices import Motion, Slices, motion, relative_slices, slices, taylor_shift
from flockopt.certificate.plan_file import Plan
from flockopt.errors import SolverFailed, require
from flockopt.records.arrays import FloatArray
from flockopt.scene import Box, Cylinder, Obstacle, Point, Scene

__all__ = ["least_clearance", "least_separation"]


#: A search that has looked at this many stretches ends with the bound it has.
MOST_STRETCHES = 200_000


def least_clearance(scene: Scene, plan: Plan) -> Nearest | None:
    """The drone, the obstacle and the moment that come nearest; None without obstacles.

    Raises:
        MissingExtra: If python-fcl is not installed.
    """
    gauge = _Gauge()
    shapes = [gauge.shape(obstacle) for obstacle in scene.obstacles]
    boxes = np.array([_box(obstacle) for obstacle in scene.obstacles])
    nearest = None
    for i, whole in enumerate(_motions(scene, plan) if shapes else ()):
        needs = np.full(len(shapes), scene.drones[i].radius + scene.clearance)
        known = np.inf if nearest is None else nearest.margin
        margin, time, k = _search(gauge, slices(whole), shapes, boxes, needs, known, RESOLUTION_M)
        nearest = _nearer(nearest, margin, time, whole, i, k)
    return nearest


def least_separation(scene: Scene, plan: Plan) -> Nearest | None:
    """The two drones and the moment that come nearest; None for one drone.

    Space is scaled so that the ellipsoid between the two becomes the unit ball: then one drone as seen from the other is a
    point that stays out of it.

    Raises:
        MissingExtra: If python-fcl is not installed.
    """
    gauge = _Gauge()
    motions = _motions(scene, plan)
    other, origin, need = [gauge.point()], np.zeros((1, 2, 3)), np.ones(1)
    nearest = None
    for gap, i, j in _pairs_by_gap(scene, motions):
        known = np.inf if nearest is None else nearest.margin
        if gap >= known:
            break
        axes = _axes(scene, i, j)
        scale = float(axes[0])
        margin, time, hit = _search(
            gauge, relative_slices(motions[i], motions[j], axes), other, origin, need, known / scale, RESOLUTION_M / scale
        )
        nearest = _nearer(nearest, margin * scale, time, motions[i], i, j if hit >= 0 else -1)
    return nearest


def _nearer(nearest: Nearest | None, margin: float, time: float, whole: Motion, drone: int, other: int) -> Nearest | None:
    """The nearest moment so far, after a search that found ``other`` at ``margin`` or nothing (-1) below it."""
    if other >= 0:
        return Nearest(margin, time, _place(whole, time), drone, other)
    return None if nearest is None else replace(nearest, margin=min(nearest.margin, margin))


class _Gauge:
    """Measures distances from a point with FCL."""

    def __init__(self) -> None:
        self.fcl = require("fcl", extra="trajectory", package="python-fcl")
        self.probe = self.point()

    def point(self) -> Any:
        """A point at the origin: a ball of radius 0."""
        return self.fcl.CollisionObject(self.fcl.Sphere(0.0), self.fcl.Transform())

    def shape(self, obstacle: Obstacle) -> Any:
        """An obstacle as FCL knows it."""
        turn = np.eye(3)
        if isinstance(obstacle, Box):
            cos, sin = np.cos(obstacle.yaw), np.sin(obstacle.yaw)
            turn[:2, :2] = [[cos, -sin], [sin, cos]]
            geometry = self.fcl.Box(*obstacle.size)
        elif isinstance(obstacle, Cylinder):
            geometry = self.fcl.Cylinder(obstacle.radius, obstacle.height)
        else:
            geometry = self.fcl.Sphere(obstacle.radius)
        return self.fcl.CollisionObject(geometry, self.fcl.Transform(turn, np.array(obstacle.center)))

    def measure(self, place: FloatArray, shape: Any) -> tuple[float, FloatArray]:
        """Distance of a place (3,) m from a shape, 0 inside it, and the direction (3,) away from its nearest point."""
        self.probe.setTranslation(place)
        request, result = self.fcl.DistanceRequest(enable_nearest_points=True), self.fcl.DistanceResult()
        distance = self.fcl.distance(self.probe, shape, request, result)
        if distance <= 0.0:
            return 0.0, np.zeros(3)
        away = place - np.asarray(result.nearest_points[1])
        length = float(np.linalg.norm(away))
        if not abs(length - distance) <= 1e-9 + 1e-9 * distance:
            raise SolverFailed("python-fcl", f"its nearest point is {length:g} m away, its distance {distance:g} m")
        return distance, away / length


def _search(
    gauge: _Gauge, parts: Slices, shapes: list[Any], boxes: FloatArray, needs: FloatArray, known: float, resolution: float
) -> tuple[float, float, int]:
    """Least of distance - need over all slices and shapes.

    Args:
        gauge: What measures.
        parts: S slices of the moving point.
        shapes: K shapes that stand still.
        boxes: (K, 2, 3) around the shapes.
        needs: (K,) distances to keep.
        known: Margins from here on need not be found.
        resolution: How far the answer may lie below the true margin; it never lies above.

    Returns:
        The margin, its time and shape; (about ``known``, -1, -1) if it is not below that.
    """
    best, time, nearest = known, -1.0, -1
    stretches: list[tuple[float, int, int, float, float]] = []  # bound, slice, shape, begin, end since the middle
    waiting = _by_bound(parts.boxes(), boxes, needs)
    upcoming = next(waiting, None)
    proven = np.inf
    for _ in range(MOST_STRETCHES):
        while upcoming is not None and (not stretches or upcoming[0] <= stretches[0][0]):
            bound, s, k = upcoming
            heapq.heappush(stretches, (bound, s, k, -float(parts.halves[s]), float(parts.halves[s])))
            upcoming = next(waiting, None)
        proven = stretches[0][0] if stretches else np.inf
        if proven >= best - resolution:
            break
        _, s, k, begin, end = heapq.heappop(stretches)
        middle, half = 0.5 * (begin + end), 0.5 * (end - begin)
        terms = taylor_shift(parts.terms[s], middle)
        distance, away = gauge.measure(terms[:, 0], shapes[k])
        margin = distance - float(needs[k])
        if margin < best:
            best, time, nearest = margin, float(parts.middles[s]) + middle, k
        if distance == 0.0:
            return best, time, nearest  # no distance is less
        along = away @ terms  # (D,) the way away from the nearest point
        for sign, begins, ends in ((-1.0, begin, middle), (1.0, middle, end)):
            bound = margin + _least_way(along, sign, half)
            if bound < best:
                heapq.heappush(stretches, (bound, s, k, begins, ends))
    return min(best, proven), time, nearest


def _least_way(along: FloatArray, sign: float, half: float) -> float:
    """A lower bound on a polynomial (D,) minus its value at 0, between 0 and ``sign * half``.

    Exact for the terms up to the square; the higher ones are bounded by their sizes.
    """
    slope = sign * float(along[1]) if len(along) > 1 else 0.0
    bend = float(along[2]) if len(along) > 2 else 0.0
    least = min(0.0, slope * half + bend * half * half)
    if bend > 0.0 and slope < 0.0 and -slope < 2.0 * bend * half:
        least = -slope * slope / (4.0 * bend)
    return least - float(np.abs(along[3:]) @ half ** np.arange(3, len(along)))


def _by_bound(parts: FloatArray, boxes: FloatArray, needs: FloatArray) -> Iterator[tuple[float, int, int]]:
    """(least margin that their boxes allow, slice, shape), the smallest first."""
    apart = np.maximum(parts[:, None, 0] - boxes[None, :, 1], boxes[None, :, 0] - parts[:, None, 1])  # (S, K, 3)
    bounds = np.linalg.norm(np.maximum(apart, 0.0), axis=2) - needs
    for flat in np.argsort(bounds, axis=None, kind="stable"):
        s, k = divmod(int(flat), bounds.shape[1])
        yield float(bounds[s, k]), s, k


def _axes(scene: Scene, i: int, j: int) -> FloatArray:
    """(3,) m, half axes of the ellipsoid that two drones keep: the separation's, no smaller across than both bodies."""
    across = max(scene.separation, scene.drones[i].radius + scene.drones[j].radius)
    return np.array([across, across, across if scene.separation_z is None else scene.separation_z])


def _pairs_by_gap(scene: Scene, motions: list[Motion]) -> Iterator[tuple[float, int, int]]:
    """(margin in metres that boxes around whole motions leave, drone, drone), the smallest first."""
    boxes = [slices(whole).boxes() for whole in motions]
    lowers, uppers = np.array([box[:, 0].min(axis=0) for box in boxes]), np.array([box[:, 1].max(axis=0) for box in boxes])
    first, second = np.triu_indices(len(motions), 1)
    apart = np.maximum(np.maximum(lowers[first] - uppers[second], lowers[second] - uppers[first]), 0.0)
    axes = np.array([_axes(scene, i, j) for i, j in zip(first.tolist(), second.tolist(), strict=True)]).reshape(-1, 3)
    gaps = (np.linalg.norm(apart / axes, axis=1) - 1.0) * axes[:, 0]
    for pair in np.argsort(gaps, kind="stable"):
        yield float(gaps[pair]), int(first[pair]), int(second[pair])


def _motions(scene: Scene, plan: Plan) -> list[Motion]:
    curves = [plan.flights[drone.id].curve if drone.id in plan.flights else None for drone in scene.drones]
    end_time = max((curve.end_time for curve in curves if curve is not None), default=0.0)
    return [motion(curve, drone.start, end_time) for curve, drone in zip(curves, scene.drones, strict=True)]


def _box(obstacle: Obstacle) -> FloatArray:
    """The axis-aligned box (2, 3) m around an obstacle."""
    if isinstance(obstacle, Box):
        cos, sin = abs(np.cos(obstacle.yaw)), abs(np.sin(obstacle.yaw))
        x, y, z = obstacle.size
        reach = np.array([cos * x + sin * y, sin * x + cos * y, z]) / 2
    elif isinstance(obstacle, Cylinder):
        reach = np.array([obstacle.radius, obstacle.radius, obstacle.height / 2])
    else:
        reach = np.full(3, obstacle.radius)
    return np.array([obstacle.center - reach, obstacle.center + reach])


def _place(whole: Motion, time: float) -> Point:
    piece = int(np.clip(np.searchsorted(whole.times, time, side="right") - 1, 0, len(whole.terms) - 1))
    x, y, z = taylor_shift(whole.terms[piece], time - whole.times[piece])[:, 0].tolist()
    return x, y, z
