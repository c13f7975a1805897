"""Travel on a voxel grid, as in the paper: Dijkstra's costs between all places (the oracle), A* for the legs flown.

The scene is cut into cubes whose centres are 0.5 m apart; what comes nearer to an obstacle than radius + clearance is
blocked, and so is every step between neighbours that does anywhere on its way, so that legs are clear, not only their
voxels. Starts, tasks and ends seldom are centres: each is linked by a straight, clear segment to the free voxel with the
nearest centre that it sees, at most two voxels away along each axis, also where its own voxel is blocked. A place without
such a voxel has no way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SettingsError
from flockopt.geometry.distances import distances
from flockopt.geometry.free_space import FreeSpace
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.scene.scene import POSITION_TOLERANCE_M
from flockopt.travel import END, Travel
from flockopt.travel.compute import MARGIN_SHARE
from learned.paths.voxel_search import Grid, astar, center_of, dijkstra, linked_voxel, make_grid

__all__ = ["CONNECTIVITIES", "VoxelOracle", "VoxelSettings", "voxel_oracle"]

CONNECTIVITIES = (6, 26)

#: The usual side of a voxel, metres: half of the narrowest door that the scene families have.
USUAL_SIDE_M = 0.5

#: Most voxels of a grid whose side nobody set, and of any grid.
USUAL_VOXELS, MOST_VOXELS = 1_000_000, 20_000_000

#: How often voxels are halved where some place is not reached, when nobody set their side.
MOST_HALVINGS = 2


@dataclass(frozen=True)
class VoxelSettings:
    """How space is cut into voxels.

    Attributes:
        connectivity: To how many neighbours a step may lead: 6 or 26.
        side: Of a voxel, metres; None for 0.5 m, more where that makes over a million voxels, and a half or a quarter
            of it where some place could not be reached otherwise.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    connectivity: int = 26
    side: float | None = None

    def __post_init__(self) -> None:
        if self.connectivity not in CONNECTIVITIES:
            raise SettingsError("connectivity", f"is {self.connectivity!r}", "must be 6 or 26", "choose one")
        if self.side is not None:
            checks.store(self, checks.number, SettingsError, "side", above=0.0)

    def sides(self, scene: Scene) -> list[float]:
        """The sides to try, metres."""
        extent = np.array(scene.bounds.upper) - np.array(scene.bounds.lower)
        if self.side is None:
            side = max(USUAL_SIDE_M, math.cbrt(float(np.prod(extent)) / USUAL_VOXELS))
            return [side / 2**halving for halving in range(MOST_HALVINGS + 1)]
        num_voxels = float(np.prod(np.maximum(extent / self.side, 1.0)))
        if num_voxels > MOST_VOXELS:
            seen = f"is {self.side:g} m, which makes {num_voxels:.3g} voxels"
            raise SettingsError("side", seen, f"must make at most {MOST_VOXELS}", "take larger voxels")
        return [self.side]


@dataclass(frozen=True, eq=False)
class VoxelOracle:
    """Costs between all places of a scene on its grid, and the legs behind them.

    Attributes:
        travel: The costs, metres; without paths.
        side: Of a voxel, metres.
        points: (P, 3) m: the tasks, the drones' starts, the drones' ends (NaN where a route ends at its last task).
        grids: For each class of drone.
        links: For each class of drone (P,), the voxel of each place; -1 where it has none.
    """

    travel: Travel
    side: float
    points: FloatArray
    grids: tuple[Grid, ...]
    links: tuple[NDArray[np.int64], ...]

    def leg(self, drone: int, origin: int, target: int) -> FloatArray:
        """The polyline of one leg by A*, as long as its entry in the costs; arguments and result as of `Travel.path`."""
        num_drones, num_tasks = self.travel.start_task.shape
        i, j = (place if place >= 0 else num_tasks + drone + (num_drones if place == END else 0) for place in (origin, target))
        if np.isnan(self.points[[i, j]]).any():
            i = j = i if np.isnan(self.points[j]).any() else j
        if i == j or np.array_equal(self.points[i], self.points[j]):
            return self.points[i : i + 1].copy()
        drone_class = self.travel.drone_class[drone]
        grid, links = self.grids[drone_class], self.links[drone_class]
        way = astar(grid, links[i], links[j]) if min(links[i], links[j]) >= 0 else np.empty(0, dtype=np.int64)
        if not len(way):
            return np.empty((0, 3))
        turns = np.flatnonzero(np.diff(way, 2)) + 1
        corners = [center_of(grid, int(voxel)) for voxel in way[np.unique([0, *turns, len(way) - 1])]]
        return np.array([self.points[i], *corners, self.points[j]])


def voxel_oracle(scene: Scene, settings: VoxelSettings | None = None) -> VoxelOracle:
    """The oracle of a scene: grids, links and all costs.

    Raises:
        SettingsError: If the set side makes too many voxels.
    """
    settings = settings or VoxelSettings()
    for side in settings.sides(scene):
        oracle = _oracle(scene, settings.connectivity, side)
        if np.isfinite(oracle.travel.start_task).all() and np.isfinite(oracle.travel.task_task).all():
            break
    return oracle


def _oracle(scene: Scene, connectivity: int, side: float) -> VoxelOracle:
    radii, drone_class = np.unique(scene.radii, return_inverse=True)
    points = np.concatenate([scene.task_positions, scene.starts, scene.ends])
    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    gaps = distances(scene.obstacle_table, np.nan_to_num(points))  # (P, K)
    start_task, task_end = np.full((num_drones, num_tasks), np.inf), np.zeros((num_drones, num_tasks))
    task_task, start_end = np.full((len(radii), num_tasks, num_tasks), np.inf), np.zeros(num_drones)
    grids, links = [], []
    for index, radius in enumerate(radii):
        own = np.flatnonzero(drone_class == index)
        bound = own[np.isfinite(scene.ends[own, 0])]
        active = np.concatenate([np.arange(num_tasks), num_tasks + own, num_tasks + num_drones + bound])
        space, reached = _space(scene, gaps, active, float(radius) + scene.clearance)
        grids.append(make_grid(space, side, connectivity))
        links.append(np.full(len(points), -1, dtype=np.int64))
        links[-1][reached] = [linked_voxel(space, grids[-1], points[place]) for place in reached]
        costs = _costs(grids[-1], points, links[-1], num_tasks)  # (M, P) m
        task_task[index] = costs[:, :num_tasks]
        start_task[own] = costs[:, num_tasks + own].T
        task_end[bound] = costs[:, num_tasks + num_drones + bound].T
        for drone in bound:
            pair = np.array([num_tasks + drone, num_tasks + num_drones + drone])
            start_end[drone] = _costs(grids[-1], points[pair], links[-1][pair], 1)[0, 1]
    travel = Travel(start_task, task_task, task_end, start_end, drone_class.reshape(-1).astype(np.int64))
    return VoxelOracle(travel, side, points, tuple(grids), tuple(links))


def _space(scene: Scene, gaps: FloatArray, active: NDArray[np.int64], need: float) -> tuple[FreeSpace, NDArray[np.int64]]:
    """What one class of drones keeps clear of, and those of its places that are not too near an obstacle."""
    if not scene.obstacles:
        return scene.free_space(need), active
    reached = active[gaps[active].min(axis=1) >= need - POSITION_TOLERANCE_M]
    return scene.free_space(_roomy_needs(gaps[reached], need)), reached


def _roomy_needs(gaps: FloatArray, need: float) -> FloatArray:
    """How far paths keep from each obstacle, (K,) m: ``need`` and a margin that leaves room at all places.

    Args:
        gaps: (P, K) m between the places to reach and the obstacles.
        need: What must be kept, metres.
    """
    least_slack = (gaps - need).min(axis=0)  # (K,)
    needs: FloatArray = need + np.where(least_slack > 0.0, np.minimum(0.5 * least_slack, MARGIN_SHARE * need), least_slack)
    return needs


def _costs(grid: Grid, points: FloatArray, links: NDArray[np.int64], num_sources: int) -> FloatArray:
    """From the first ``num_sources`` places to all, (num_sources, P) m: along the links and the grid between them."""
    linked = np.flatnonzero(links >= 0)
    centers = np.array([center_of(grid, int(voxel)) for voxel in links[linked]]).reshape(-1, 3)
    stubs = np.full(len(points), np.inf)
    stubs[linked] = np.linalg.norm(points[linked] - centers, axis=1)
    costs = np.full((num_sources, len(points)), np.inf)
    for source in linked[linked < num_sources]:
        between = dijkstra(grid, int(links[source]), links[linked]) * grid.side
        costs[source, linked] = stubs[source] + between + stubs[linked]
        costs[source, source] = 0.0
    return costs
