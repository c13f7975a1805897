"""Travel computed: shortest any-angle distances and paths of a fleet among obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.geometry.distances import distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.scene.merging import with_merged_obstacles
from flockopt.scene.scene import POSITION_TOLERANCE_M
from flockopt.travel.travel import Paths, Travel, places, straight_travel

__all__ = ["compute_travel", "pairs_on"]


#: How much farther from obstacles than the scene asks ways keep, as a share of that: what lets smooth curves follow them.
MARGIN_SHARE = 0.0225

#: Shares of that margin with which a way is looked for where the whole of it closes one: down to none.
SMALLER_MARGINS = (0.2, 0.02, 0.0)


def compute_travel(
    scene: Scene,
    *,
    routes: Sequence[Sequence[int]] | None = None,
    wanted: NDArray[np.bool_] | None = None,
    deadline: Deadline = NEVER,
) -> Travel:
    """Shortest any-angle distances and paths that keep clear of obstacles and within bounds.

    Each obstacle is kept at ``radius + clearance`` and a margin of `MARGIN_SHARE` of that, less where an end of the
    way itself is nearer than that, and where it closes the only way: a leg depends on its two ends, its kind of drone, the
    obstacles and the bounds alone. A task too near an obstacle for a class of
    drones has no way for them.

    Args:
        scene: The scene.
        routes: Where only the legs of these routes are wanted, one route of task indices a drone; what other distances
            there are is then left open.
        wanted: The same by pairs of places, (P, P) symmetric, as in `places` and `pairs_on`.
        deadline: When to give up.

    Raises:
        OutOfTime: If the deadline passes.
    """
    if not scene.obstacles:
        return straight_travel(scene)
    scene = with_merged_obstacles(scene)
    radii, drone_class = np.unique(scene.radii, return_inverse=True)
    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    travel = Travel(
        np.full((num_drones, num_tasks), np.inf), np.full((len(radii), num_tasks, num_tasks), np.inf),
        np.zeros((num_drones, num_tasks)), np.zeros(num_drones), drone_class.reshape(-1).astype(np.int64),
    )  # fmt: skip
    points = places(scene)
    gaps = distances(scene.obstacle_table, points)  # (P, K)
    wanted = wanted if routes is None else pairs_on(scene, routes)
    legs = [
        _fill_class(scene, travel, points, gaps, index, float(radius), wanted, deadline) for index, radius in enumerate(radii)
    ]
    keys, offsets, bends = zip(*legs, strict=True)
    for array in (travel.start_task, travel.task_task, travel.task_end, travel.start_end):
        array.setflags(write=False)
    paths = Paths(points, tuple(keys), tuple(offsets), tuple(bends))
    return Travel(travel.start_task, travel.task_task, travel.task_end, travel.start_end, travel.drone_class, paths)


def pairs_on(scene: Scene, routes: Sequence[Sequence[int]]) -> NDArray[np.bool_]:
    """Which pairs of places (as in `places`) follow each other on the routes, (P, P)."""
    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    wanted = np.zeros((num_tasks + 2 * num_drones,) * 2, dtype=np.bool_)
    for drone, route in enumerate(routes):
        stops = [num_tasks + drone, *route, num_tasks + num_drones + drone]
        wanted[stops[:-1], stops[1:]] = wanted[stops[1:], stops[:-1]] = True
    return wanted


def _fill_class(
    scene: Scene,
    travel: Travel,
    points: FloatArray,
    gaps: FloatArray,
    index: int,
    radius: float,
    only: NDArray[np.bool_] | None,
    deadline: Deadline,
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Fill the distances of one class of drones; return its keys, offsets and bends for `Paths`.

    Pairs of places that ``only`` (P, P) does not hold, if it is given, are left out.
    """
    from flockopt.travel.legs import Legs
    from flockopt.travel.roadmap import roadmap_among

    num_drones, num_tasks = scene.num_drones, scene.num_tasks
    need = radius + scene.clearance
    drones = np.flatnonzero(travel.drone_class == index)
    bound = np.isfinite(scene.ends[drones, 0])
    tasks = np.flatnonzero(gaps[:num_tasks].min(axis=1) >= need - POSITION_TOLERANCE_M)
    active = np.concatenate([tasks, num_tasks + drones, num_tasks + num_drones + drones[bound]])

    def legs_with(share: float, wanted: NDArray[np.bool_]) -> Legs:
        margin = share * MARGIN_SHARE * need
        roadmap = roadmap_among(scene.obstacle_table, need, (scene.bounds.lower, scene.bounds.upper), margin)
        return roadmap.legs(points[active], wanted, deadline)

    wanted = np.zeros((len(active), len(active)), dtype=np.bool_)
    wanted[: len(tasks)] = True
    starts = len(tasks) + np.flatnonzero(bound)
    ends = len(tasks) + len(drones) + np.arange(len(starts))
    wanted[starts, ends] = True
    if only is not None:
        wanted &= only[np.ix_(active, active)]
    legs = legs_with(1.0, wanted)
    for share in SMALLER_MARGINS:
        closed = wanted & np.isinf(legs.lengths)
        if not closed.any():
            break
        legs = legs.with_more(legs_with(share, closed))

    travel.task_task[index][np.ix_(tasks, tasks)] = legs.lengths[: len(tasks), : len(tasks)]
    np.fill_diagonal(travel.task_task[index], 0.0)
    last_start = len(tasks) + len(drones)
    travel.start_task[np.ix_(drones, tasks)] = legs.lengths[len(tasks) : last_start, : len(tasks)]
    travel.task_end[drones[bound]] = np.inf
    travel.task_end[np.ix_(drones[bound], tasks)] = legs.lengths[last_start:, : len(tasks)]
    travel.start_end[drones[bound]] = legs.lengths[starts, ends]
    keys = active[legs.pairs[:, 0]] * len(points) + active[legs.pairs[:, 1]]
    return keys, legs.offsets, legs.bends
