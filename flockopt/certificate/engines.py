"""Two ways to find where a plan is tightest in space: closed forms, and FCL's distances. They must agree."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from flockopt.certificate import fcl_engine
from flockopt.certificate.case import RESOLUTION_M, JudgedCase, Nearest
from flockopt.geometry.continuous import least_clearance, least_separation

__all__ = ["ENGINES", "Engine"]


@dataclass(frozen=True)
class Engine:
    """What finds a plan's tightest moments; each gives None where there is nothing to keep.

    Attributes:
        clearance: From drones to obstacles.
        separation: From drones to drones.
    """

    clearance: Callable[[JudgedCase], Nearest | None]
    separation: Callable[[JudgedCase], Nearest | None]


def _clearance(case: JudgedCase) -> Nearest | None:
    nearest = None
    for i in range(case.scene.num_drones if case.scene.obstacles else 0):
        case.check_time()
        margin, time, k = least_clearance(case.free_space(i), *case.curves[i], RESOLUTION_M)
        if nearest is None or margin < nearest.margin:
            nearest = Nearest(margin, time, case.place(i, time), i, k)
    return nearest


def _separation(case: JudgedCase) -> Nearest | None:
    nearest, least = None, np.inf
    for gap, i, j in _pairs_by_gap(case):
        if gap > least:
            break
        case.check_time()
        axes = case.scene.axes_between(i, j)
        margin, time = least_separation(*case.curves[i], *case.curves[j], axes, 0.0, case.makespan, RESOLUTION_M, least)
        if time >= 0.0 and margin < least:
            least, nearest = margin, Nearest(margin, time, case.place(i, time), i, j)
    return nearest


def _pairs_by_gap(case: JudgedCase) -> Iterator[tuple[float, int, int]]:
    """Pairs of drones, nearest first, with a margin in metres that boxes around their whole curves leave at least."""
    lowers = np.array([control.min(axis=(0, 2)) for control in case.controls])  # (N, 3) m
    uppers = np.array([control.max(axis=(0, 2)) for control in case.controls])
    first, second = np.triu_indices(len(lowers), 1)
    apart = np.maximum(np.maximum(lowers[first] - uppers[second], lowers[second] - uppers[first]), 0.0)
    axes = case.scene.axes_between(first, second)  # (P, 3)
    gaps = (np.linalg.norm(apart / axes, axis=1) - 1.0) * axes[:, 0]
    for pair in np.argsort(gaps, kind="stable"):
        yield float(gaps[pair]), int(first[pair]), int(second[pair])


#: By name; the first is the default.
ENGINES = {
    "closed-form": Engine(_clearance, _separation),
    "fcl": Engine(
        lambda case: fcl_engine.least_clearance(case.scene, case.plan),
        lambda case: fcl_engine.least_separation(case.scene, case.plan),
    ),
}
