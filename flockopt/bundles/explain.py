"""Why an allocation leaves tasks out, in words that name the task, the shortage and the mend."""

from __future__ import annotations

import numpy as np

from flockopt.bundles.bundles import Bundles
from flockopt.bundles.request import RouteTuple
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel
from flockopt.travel.enclosure import Enclosure

__all__ = ["LENGTH_TOLERANCE_M", "explained", "may_be_overlooked"]

#: Slack on a drone's `max_distance`, metres: what summing legs in another order may lose.
LENGTH_TOLERANCE_M = 1e-9

#: How many tasks and reasons a reason names before it stops.
MOST_NAMED = 5


#: What is said of tasks that are left over without a proof that they must be.
NOT_FOUND = (
    "no allocation that serves all tasks was found; none is proven impossible: give it more time or try the planner exact"
)


def explained(scene: Scene, travel: Travel, routes: RouteTuple) -> Bundles:
    """Bundles of these routes: feasible; or incomplete, or proven infeasible, with what is left over and why."""
    served = {task for route in routes for task in route}
    left = [task for task in range(scene.num_tasks) if task not in served]
    idle = [drone for drone, route in enumerate(routes) if not route]
    walls = _Walls(scene)
    ends = [fault for fault in (_end_fault(scene, travel, drone, walls) for drone in idle) if fault is not None]
    if not left and not ends:
        return Bundles(routes)
    faults = [words for words, _ in ends]
    short = scene.demands.sum() - scene.capacities.sum()
    if short > 0:
        faults.append(
            f"the tasks demand {scene.demands.sum():g} and the fleet carries {scene.capacities.sum():g}: {short:g} too little; "
            "add drones or raise capacities"
        )
    told = [(task, *_task_fault(scene, travel, task, short > 0, walls)) for task in left]
    unserved = tuple((task, reason) for task, reason, _ in told)
    is_proven = short > 0 or any(proven for _, proven in ends) or any(proven for _, _, proven in told)
    reasons = list(dict.fromkeys([*faults, *(reason for _, reason in unserved)]))
    named = reasons[:MOST_NAMED] + ["..."] * (len(reasons) > MOST_NAMED)
    if is_proven:
        return Bundles(routes, unserved, Status.INFEASIBLE, "; ".join(named))
    return Bundles(routes, unserved, Status.INCOMPLETE, "; ".join([NOT_FOUND, *named]))


class _Walls:
    """What drones of each radius are kept from, worked out when it is asked for."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._enclosures: dict[float, Enclosure] = {}

    def keep_apart(self, drone: int, place: FloatArray) -> bool:
        """Whether it is proven that a drone has no way from its start to a place (3,)."""
        radius = self._scene.drones[drone].radius
        if radius not in self._enclosures:
            self._enclosures[radius] = Enclosure(self._scene, radius)
        return self._enclosures[radius].keeps_apart(self._scene.starts[drone], place)


def may_be_overlooked(scene: Scene, travel: Travel) -> bool:
    """Whether some drone could carry a task that no way to was found for, though nothing proves that there is none."""
    walls = _Walls(scene)
    able = (scene.capacities[:, None] >= scene.demands) & ~np.isfinite(travel.start_task)
    return any(not walls.keep_apart(drone, scene.task_positions[task]) for drone, task in np.argwhere(able).tolist())


def _end_fault(scene: Scene, travel: Travel, drone: int, walls: _Walls) -> tuple[str, bool] | None:
    """Why a drone without tasks cannot even fly to its end, and whether that is proven; None if it can."""
    record, length = scene.drones[drone], travel.start_end[drone]
    if not np.isfinite(length):
        proven = walls.keep_apart(drone, scene.ends[drone])
        return f"drone {record.id!r}: {_no_way('to its end', proven)}; move the end", proven
    if record.max_distance is not None and length > record.max_distance + LENGTH_TOLERANCE_M:
        reach = f"its max_distance is {record.max_distance:g}"
        return f"drone {record.id!r} is {length:g} m from its end and {reach}; raise it", True
    return None


def _no_way(where: str, proven: bool) -> str:
    if proven:
        return f"there is no way {where}, and that is proven"
    return f"no way {where} was found, which proves nothing"


def _task_fault(scene: Scene, travel: Travel, task: int, is_short: bool, walls: _Walls) -> tuple[str, bool]:
    """Why no drone serves the task, and whether that is proven."""
    head, demand = f"task {scene.tasks[task].id!r}", scene.demands[task]
    if scene.capacities.max() == 0:
        return f"{head} is left over; no drone has any capacity left; add drones", True
    if demand > scene.capacities.max():
        most = scene.capacities.max()
        return f"{head} demands {demand:g}, more than any capacity ({most:g}); split it or raise a capacity", True
    able = scene.capacities >= demand
    alone = np.where(able, travel.start_task[:, task] + travel.task_end[:, task], np.inf)  # (N,) m
    if not np.isfinite(alone).any():
        need = float(scene.radii[able].min()) + scene.clearance
        proven = all(walls.keep_apart(drone, scene.task_positions[task]) for drone in np.flatnonzero(able).tolist())
        way = _no_way(f"that keeps radius + clearance ({need:.6g} m)", proven)
        return f"{head} cannot be reached by any drone that can carry it: {way}; move it or the obstacles", proven
    limits = np.array([np.inf if drone.max_distance is None else drone.max_distance for drone in scene.drones])
    if not (alone <= limits + LENGTH_TOLERANCE_M).any():
        return f"{head} is too far for every drone's max_distance (at least {alone.min():g} m); raise one", True
    if is_short:
        return f"{head} is left over; the fleet is full", True
    return f"{head} is left over; no drone was found to have room for it; raise capacities or max_distance", False
