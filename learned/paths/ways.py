"""Ways between places, by kind of path: what they cost, and the legs that cost it.

``any-angle`` legs are the spine's shortest paths; ``voxel26`` and ``voxel6`` go along the edges of a voxel grid, as in
the paper: Dijkstra's costs for the allocation, A* for the legs that are flown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from flockopt.errors import SettingsError
from flockopt.planning.planners import ANY_ANGLE
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel

__all__ = ["ANY_ANGLE", "PATHS", "LegPlanner", "Ways", "find_ways"]

#: To how many neighbours a step on the grid may lead.
CONNECTIVITY_OF = {"voxel26": 26, "voxel6": 6}

#: The kinds of path.
PATHS = (ANY_ANGLE, *CONNECTIVITY_OF)

#: The polyline (V, 3) m that a drone flies from one place to another, both included; (1, 3) where it stays, (0, 3)
#: where there is no way. Arguments as of `flockopt.travel.Travel.path`, which is one.
LegPlanner: TypeAlias = Callable[[int, int, int], FloatArray]


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways of one kind in a scene.

    Attributes:
        travel: What they cost.
        leg: Makes one of them.
    """

    travel: Travel
    leg: LegPlanner


def find_ways(
    scene: Scene, paths: str = ANY_ANGLE, *, travel: Travel | None = None, routes: Sequence[Sequence[int]] | None = None
) -> Ways:
    """The ways of one kind. What a voxel grid has no way to is reached any-angle, where that is possible.

    Args:
        scene: The scene.
        paths: One of `PATHS`.
        travel: The scene's any-angle travel, if it is already there.
        routes: Where only the legs of these routes are wanted, one route of task indices a drone: other any-angle ways
            are not looked for.

    Raises:
        SettingsError: On paths of another kind.
    """
    checks.choice(SettingsError, "paths", paths, known=PATHS)
    if paths == ANY_ANGLE:
        travel = compute_travel(scene, routes=routes) if travel is None else travel
        return Ways(travel, travel.path)
    from learned.paths.voxels import VoxelSettings, voxel_oracle

    oracle = voxel_oracle(scene, VoxelSettings(CONNECTIVITY_OF[paths]))
    matrices = {name: getattr(oracle.travel, name) for name in ("start_task", "task_task", "task_end", "start_end")}
    if all(np.isfinite(matrix).all() for matrix in matrices.values()):
        return Ways(oracle.travel, oracle.leg)
    anywhere = compute_travel(scene, routes=routes) if travel is None else travel
    filled = {name: np.where(np.isfinite(grid), grid, getattr(anywhere, name)) for name, grid in matrices.items()}

    def leg(drone: int, origin: int, target: int) -> FloatArray:
        path = oracle.leg(drone, origin, target)
        return path if len(path) else anywhere.path(drone, origin, target)

    return Ways(replace(oracle.travel, **filled), leg)
