"""From a scene and bundles to the arrays that a student reads, and from a way to those it learns from.

A drone's anchors are its start, its tasks in order and its end if it has one. They sit at fixed samples, shared out
in proportion to the legs' lengths; legs whose straight line is clear have little to draw and get fewer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray, IntArray
from flockopt.scene import Scene
from learned.paths.rollout import anchors_of
from learned.student.legs.layout import lay_out

__all__ = ["Example", "example", "unassigned", "with_ways"]


@dataclass(frozen=True)
class Example:
    """A scene with bundles, as arrays; with ``target`` one to learn from.

    Attributes:
        scene: The scene itself.
        routes: Bundles.
        leg_index: (N, T) which leg a sample lies on, 0-based; a task's sample counts to the leg that ends there.
        leg_begin, leg_end: (N, T) the samples of that leg's anchors.
        straight: (N, T, 3) m, samples along the straight legs.
        blocked: (N, T) whether the straight line of the sample's leg is blocked.
        target: (N, T, 3) m, samples of the way to learn, its anchors at the same places as ``straight``'s; or None.
        teaches_allocation: Whether the bundles are worth imitating; those of hard scenes are drawn at random.
    """

    scene: Scene
    routes: tuple[tuple[int, ...], ...]
    leg_index: IntArray
    leg_begin: IntArray
    leg_end: IntArray
    straight: FloatArray
    blocked: NDArray[np.bool_]
    target: FloatArray | None = None
    teaches_allocation: bool = True

    @property
    def active(self) -> NDArray[np.bool_]:
        """(N,), m in the paper: drones that go anywhere."""
        return np.greater(self.leg_end.max(axis=1), 0)

    @property
    def is_blocked(self) -> NDArray[np.bool_]:
        """(N,): drones with a leg whose straight line is not clear."""
        return np.logical_or.reduce(self.blocked, axis=1)


def example(scene: Scene, routes: Sequence[Sequence[int]], num_samples: int = 64) -> Example:
    """The arrays of a scene with bundles.

    Raises:
        SettingsError: If a drone has more anchors than samples.
    """
    anchors = [anchors_of(scene, drone, route) for drone, route in enumerate(routes)]
    for drone, own in enumerate(anchors):
        if len(own) > num_samples:
            rule = f"a drone has at most {num_samples - 1} legs"
            raise SettingsError(f"bundles[{drone}]", f"makes {len(own) - 1} legs", rule, "spread the tasks over more drones")
    straight = np.repeat(scene.starts[:, None], num_samples, axis=1)
    legs = np.zeros((3, scene.num_drones, num_samples), dtype=np.int64)
    blocked = np.zeros((scene.num_drones, num_samples), dtype=np.bool_)
    for drone, own in enumerate(anchors):
        if len(own) > 1:
            space = scene.free_space(scene.radii[drone] + scene.clearance)
            legs[:, drone], blocked[drone] = lay_out(space, own, straight[drone])
    leg_index, leg_begin, leg_end = legs
    return Example(scene, tuple(tuple(route) for route in routes), leg_index, leg_begin, leg_end, straight, blocked)


def unassigned(scene: Scene) -> Example:
    """A scene before there are bundles, with one sample a drone: all that an allocation head reads."""
    nothing = np.zeros((scene.num_drones, 1), dtype=np.int64)
    routes: tuple[tuple[int, ...], ...] = ((),) * scene.num_drones
    return Example(scene, routes, nothing, nothing, nothing, scene.starts[:, None], nothing > 0)


def with_ways(base: Example, legs: Sequence[Sequence[FloatArray]], *, teaches_allocation: bool = True) -> Example:
    """The example with ways as its target: for each drone the polylines (V, 3) m of its legs.

    Where the straight line is clear there is nothing to learn: the target is that line.
    """
    target = base.straight.copy()
    for drone, ways in enumerate(legs):
        for leg, way in enumerate(ways):
            at = np.flatnonzero(base.leg_index[drone] == leg)[-1]
            first, last = base.leg_begin[drone, at], base.leg_end[drone, at]
            if base.blocked[drone, at]:
                target[drone, first : last + 1] = _resampled(way, int(last - first))
    return replace(base, target=target, teaches_allocation=teaches_allocation)


def _resampled(way: FloatArray, num_parts: int) -> FloatArray:
    """(num_parts + 1, 3) m: a polyline (V, 3) at equal distances along it."""
    lengths = [math.dist(p, q) for p, q in pairwise(way)]
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = np.linspace(0.0, along[-1], num_parts + 1)
    return np.stack([np.interp(wanted, along, way[:, axis]) for axis in range(3)], axis=1)
