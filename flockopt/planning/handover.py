"""Where a flying fleet is at one moment, as a scene of its own: what is left to do, and from which state."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flockopt.certificate import Plan
from flockopt.errors import SceneError, SettingsError
from flockopt.flights import Flight
from flockopt.geometry.distances import distances
from flockopt.scene import Drone, Point, Scene, Task
from flockopt.scene.scene import POSITION_TOLERANCE_M

__all__ = ["Changes", "Situation", "check_added", "hand_over", "too_near"]

#: Slower than this and accelerating less, a drone stands still: what rounding leaves of a rest.
REST_SPEED_MPS, REST_ACCELERATION_MPS2 = 1e-9, 1e-7

#: What is left of a range is at least this, metres, so that a drone at the end of it is still a valid one.
LEAST_DISTANCE_M = 1e-6


@dataclass(frozen=True)
class Changes:
    """What has happened to a flying fleet.

    Attributes:
        added: New tasks.
        removed: Ids of tasks that need no visit any more.
        lost: Ids of drones that are out of the air.
        late: Seconds from the event until a drone that stands still at the swap can move again, by id.
        missed: Ids of tasks that the plan has visited, but nobody has served: they are open again.
    """

    added: tuple[Task, ...] = ()
    removed: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    late: dict[str, float] = field(default_factory=dict)
    missed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Situation:
    """A fleet at the moment of the swap.

    Attributes:
        scene: Drones where and as they fly then, with what capacity they have left; all open tasks.
        routes: What is left of each drone's old route, as task indices of ``scene``.
        flights: What is left of the old flights, by drone id, beginning at the swap.
        ready_s: Seconds after the swap until a drone may set off (it serves a task, or is late), by id.
        astray: Ids of drones whose old flight leads to tasks that need no visit any more.
        unreachable: Reasons by id of tasks that none of the drones left can come to; they are not in ``scene``.
        earlier: Task indices of ``scene`` that were there before the event, and are not given up for new ones.
    """

    scene: Scene
    routes: tuple[tuple[int, ...], ...]
    flights: dict[str, Flight]
    ready_s: dict[str, float]
    astray: frozenset[str]
    unreachable: dict[str, str]
    earlier: frozenset[int]


def hand_over(scene: Scene, plan: Plan, swap_s: float, changes: Changes, now_s: float | None = None) -> Situation:
    """The situation at ``swap_s`` seconds on the plan's clock.

    Args:
        scene: The scene of the plan being flown.
        plan: The plan being flown.
        swap_s: Until when it is flown.
        changes: What has happened.
        now_s: When it happened, ``swap_s`` at the latest, which is the default: lost drones serve nothing after it, and late
            ones are late from then on.

    Raises:
        SceneError: If a new task is not valid in the scene, or rounding makes the moment invalid (two drones only just
            apart).
        SettingsError: If a drone said to be late is in motion.
    """
    begun = {visit.task for flight in plan.flights.values() for visit in flight.visits if visit.time <= swap_s}
    event_s = swap_s if now_s is None else now_s
    late = {drone: seconds - (swap_s - event_s) for drone, seconds in changes.late.items()}
    broken_off = {task for drone in changes.lost for task in _unfinished(scene, plan, drone, event_s, swap_s)}
    closed = (begun - broken_off - set(changes.missed)) | set(changes.removed)
    fleet = [drone for drone in scene.drones if drone.id not in changes.lost]
    open_tasks = (*(task for task in scene.tasks if task.id not in closed), *changes.added)
    unreachable = too_near(scene, fleet, open_tasks) if len(fleet) < scene.num_drones else {}
    tasks = tuple(task for task in open_tasks if task.id not in unreachable)
    drones = tuple(_drone_then(scene, plan, drone, swap_s, changes) for drone in fleet)
    left = scene.replace(drones=drones, tasks=tasks)
    index = {task.id: j for j, task in enumerate(tasks)}
    ahead = set(index) - set(changes.missed)
    routes = tuple(tuple(index[task] for task in plan.routes.get(drone.id, ()) if task in ahead) for drone in fleet)
    ready_s = {drone.id: max(_late(drone, late), _busy(scene, plan, drone, swap_s)) for drone in drones}
    flights = {}
    for drone in drones:
        flight = _rest_of(plan, drone.id, swap_s, set(index))
        if flight is not None:
            wait_s = late.get(drone.id, 0.0) - flight.curve.start_time
            flights[drone.id] = flight.shifted(wait_s) if wait_s > 0.0 else flight
    dropped = set(changes.removed) - begun
    astray = frozenset(drone.id for drone in fleet if dropped & set(plan.routes.get(drone.id, ())))
    earlier = frozenset(index.values()) - {index[task.id] for task in changes.added if task.id in index}
    return Situation(left, routes, flights, ready_s, astray, unreachable, earlier)


def check_added(scene: Scene, added: Sequence[Task]) -> None:
    """Refuse new tasks that are not valid beside those of a scene.

    Raises:
        SceneError: With a field that names the task by its id, as in ``added['t7'].position``.
    """
    try:
        scene.replace(tasks=(*scene.tasks, *added))
    except SceneError as fault:
        place = re.match(r"tasks\[(\d+)\]", fault.field)
        if place is None or int(place[1]) < scene.num_tasks:
            raise
        name = added[int(place[1]) - scene.num_tasks].id
        field = f"added[{name!r}]{fault.field[place.end() :]}"
        raise SceneError(field, fault.value, fault.rule, fault.mend) from None


def too_near(scene: Scene, fleet: Sequence[Drone], tasks: Sequence[Task]) -> dict[str, str]:
    """Reasons by id of the tasks that are too near an obstacle of the scene for the smallest drone of a fleet."""
    if not tasks or not scene.obstacles:
        return {}
    need = min(drone.radius for drone in fleet) + scene.clearance
    gaps = distances(scene.obstacle_table, np.array([task.position for task in tasks])).min(axis=1)
    words = "is {:.4g} m from an obstacle; the smallest drone left needs {:g} m; add a smaller one"
    near = gaps < need - POSITION_TOLERANCE_M
    return {task.id: words.format(gap, need) for task, gap, is_near in zip(tasks, gaps, near, strict=True) if is_near}


def _drone_then(scene: Scene, plan: Plan, drone: Drone, swap_s: float, changes: Changes) -> Drone:
    """The drone as it flies at the swap: its state, and what is left of its capacity and range."""
    flight = plan.flights.get(drone.id)
    end = drone.end_point if drone.end is not None else None
    if flight is None:
        return replace(drone, end=end)
    curve = flight.curve
    position = np.clip(curve(swap_s), scene.bounds.lower, scene.bounds.upper)
    velocity, acceleration = curve(swap_s, 1), curve(swap_s, 2)
    if np.linalg.norm(velocity) < REST_SPEED_MPS and np.linalg.norm(acceleration) < REST_ACCELERATION_MPS2:
        velocity = acceleration = np.zeros(3)
    demands = {task.id: task.demand for task in scene.tasks}
    carried = sum(demands[visit.task] for visit in flight.visits if visit.time <= swap_s and visit.task not in changes.missed)
    max_distance = drone.max_distance
    if max_distance is not None:
        rest = curve.after(swap_s)
        max_distance = max(max_distance - curve.length + (0.0 if rest is None else rest.length), LEAST_DISTANCE_M)
    return replace(
        drone, start=_point(position), velocity=_point(velocity), acceleration=_point(acceleration), end=end,
        capacity=max(drone.capacity - carried, 0), max_distance=max_distance,
    )  # fmt: skip


def _point(vector: np.ndarray) -> Point:
    x, y, z = (float(value) for value in vector)
    return x, y, z


def _unfinished(scene: Scene, plan: Plan, drone: str, now_s: float, until_s: float) -> dict[str, float]:
    """Tasks that a drone begins to serve by ``until_s`` but has not done with at ``now_s``, and the seconds from then on."""
    service_s = {task.id: task.service_time for task in scene.tasks}
    flight = plan.flights.get(drone)
    visits = flight.visits if flight is not None else ()
    ends = {visit.task: visit.time + service_s[visit.task] - now_s for visit in visits if visit.time <= until_s}
    return {task: seconds for task, seconds in ends.items() if seconds > 0.0}


def _late(drone: Drone, late: Mapping[str, float]) -> float:
    """Seconds from the swap until a late drone can move."""
    seconds = max(late.get(drone.id, 0.0), 0.0)
    if seconds > 0.0 and (any(drone.velocity) or any(drone.acceleration)):
        raise SettingsError("late", f"names {drone.id!r}", "only a drone that stands still can be late", "leave it out")
    return seconds


def _busy(scene: Scene, plan: Plan, drone: Drone, swap_s: float) -> float:
    """Seconds from the swap until a drone has done with the task that it serves then."""
    return max(_unfinished(scene, plan, drone.id, swap_s, swap_s).values(), default=0.0)


def _rest_of(plan: Plan, drone: str, swap_s: float, open_tasks: set[str]) -> Flight | None:
    """What is left of a drone's flight, with the visits that are still wanted."""
    flight = plan.flights.get(drone)
    curve = None if flight is None else flight.curve.after(swap_s)
    if flight is None or curve is None:
        return None
    visits = tuple(
        replace(visit, time=visit.time - swap_s) for visit in flight.visits if visit.time > swap_s and visit.task in open_tasks
    )
    return Flight(curve, visits)
