"""What a judge works with: a plan beside its scene, and the tightest of many margins."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.bundles import Bound
from flockopt.certificate.certificate import Clause
from flockopt.certificate.plan_file import LARGEST_DEGREE, Plan
from flockopt.errors import PlanError
from flockopt.flights import Flight
from flockopt.geometry.bernstein import control_points, piece_states
from flockopt.geometry.continuous import parked
from flockopt.geometry.free_space import FreeSpace
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Point, Scene
from flockopt.travel import Travel

__all__ = ["RESOLUTION_M", "JudgedCase", "Nearest", "Worst", "check_names", "to_point"]

#: The margin of what cannot be measured, such as a cost that is missing.
BEYOND_MEASURE = -1e12


def check_names(scene: Scene, plan: Plan) -> None:
    """Refuse a plan that is for another scene, or that names drones or tasks which the scene does not have."""
    if plan.scene_sha256 != scene.sha256:
        raise PlanError(
            "scene.sha256", f"is {plan.scene_sha256}", f"the scene's is {scene.sha256}", "give the scene it was made for"
        )  # fmt: skip
    drones, tasks = {drone.id for drone in scene.drones}, {task.id for task in scene.tasks}
    for kind, table in (("routes", plan.routes), ("trajectories", plan.flights)):
        for index, name in enumerate(table):
            _check_known(f"{kind}[{index}].drone", name, drones, "drone")
    for index, route in enumerate(plan.routes.values()):
        for rank, name in enumerate(route):
            _check_known(f"routes[{index}].tasks[{rank}]", name, tasks, "task")
    for index, flight in enumerate(plan.flights.values()):
        for rank, visit in enumerate(flight.visits):
            _check_known(f"trajectories[{index}].visits[{rank}].task", visit.task, tasks, "task")
    for index, name in enumerate(plan.unserved):
        _check_known(f"unserved[{index}].task", name, tasks, "task")


def _check_known(field: str, name: str, known: set[str], kind: str) -> None:
    if name not in known:
        raise PlanError(field, f"is {name!r}", f"must be a {kind} of the scene", "correct it or give the plan's own scene")


@dataclass(frozen=True)
class JudgedCase:
    """A plan before the judge, with what several clauses look at."""

    scene: Scene
    plan: Plan
    travel: Travel
    proof: Bound | None
    deadline: Deadline = NEVER
    rounding: float = 0.0

    @cached_property
    def routes(self) -> list[list[int]]:
        """Task indices in order, one list for every drone."""
        number = {task.id: index for index, task in enumerate(self.scene.tasks)}
        return [[number[task] for task in self.plan.routes.get(drone.id, ())] for drone in self.scene.drones]

    @cached_property
    def flights(self) -> list[tuple[Drone, Flight]]:
        """The drones that move."""
        return [(drone, self.plan.flights[drone.id]) for drone in self.scene.drones if drone.id in self.plan.flights]

    @cached_property
    def curves(self) -> list[tuple[FloatArray, FloatArray]]:
        """Breakpoints and coefficients of every drone, parked ones included."""
        curves = []
        for drone in self.scene.drones:
            flight = self.plan.flights.get(drone.id)
            resting = parked(np.array(drone.start))
            moving = None if flight is None else (flight.curve.breakpoints, _trimmed(flight.curve.coefficients))
            curves.append(moving or resting)
        return curves

    @cached_property
    def controls(self) -> list[FloatArray]:
        """Every drone's control points, (K, 3, D) m."""
        return [control_points(times, terms, terms.shape[2]) for times, terms in self.curves]

    @cached_property
    def states(self) -> list[tuple[FloatArray, FloatArray]]:
        """Every drone's position, velocity and acceleration where its pieces begin and end, each (K, 3, 3)."""
        return [piece_states(times, terms) for times, terms in self.curves]

    def blur(self, drone: int) -> FloatArray:
        """(K, 3) by how much the rounding of coefficients may move position, velocity and acceleration at a piece's end."""
        times, terms = self.curves[drone]
        if self.rounding == 0.0:
            return np.zeros((len(terms), 3))
        powers, spans = np.arange(terms.shape[2]), np.diff(times)[:, None]
        factors = np.stack([np.ones_like(powers), powers, powers * (powers - 1)])  # (3, D)
        raised = np.stack([spans ** np.maximum(powers - order, 0) for order in range(3)], axis=1)  # (K, 3, D)
        moved: FloatArray = math.sqrt(3.0) * self.rounding * (factors * raised).sum(axis=2)
        return moved

    @property
    def makespan(self) -> float:
        """Seconds until the last drone has finished."""
        return max((flight.curve.end_time for _, flight in self.flights), default=0.0)

    def check_time(self) -> None:
        """Raise `flockopt.batches.deadline.OutOfTime` if the deadline has passed."""
        self.deadline.check("judging the plan")

    def place(self, drone: int, time: float) -> Point:
        """Where a drone is at a time."""
        if self.scene.drones[drone].id not in self.plan.flights:
            return self.scene.drones[drone].start
        times, terms = self.curves[drone]
        inside = min(max(time, float(times[0])), float(times[-1]))
        piece = min(int(times.searchsorted(inside, side="right")) - 1, len(terms) - 1)
        return to_point(terms[piece] @ (inside - times[piece]) ** np.arange(terms.shape[2]))

    def free_space(self, drone: int) -> FreeSpace:
        """What a drone keeps clear of: the same for all that are as large."""
        reach = self.scene.drones[drone].radius + self.scene.clearance
        if reach not in self._spaces:
            self._spaces[reach] = self.scene.free_space(reach)
        return self._spaces[reach]

    @cached_property
    def _spaces(self) -> dict[float, FreeSpace]:
        return {}


@dataclass
class Worst:
    """The tightest of several margins, with the fields of the clause that say where it is."""

    margin: float = math.inf
    where: dict[str, Any] = field(default_factory=dict)

    def lets(self, margin: float) -> bool:
        """Whether a margin is no news: what to say of it need not be worked out."""
        return margin >= self.margin

    def see(self, margin: float, **where: Any) -> None:
        """Take note of one margin; one that is not a number is the worst of all."""
        if not self.lets(margin):
            self.margin, self.where = max(margin, BEYOND_MEASURE) if margin > -math.inf else BEYOND_MEASURE, where

    def clause(self, name: str, unit: str, tolerance: float = 0.0, note: str = "") -> Clause:
        """The verdict, with the detail of the tightest margin where it fails and the note where it holds."""
        holds = self.margin >= -tolerance
        detail = note if holds else self.where.get("detail", "")
        return Clause(name, holds, self.margin, unit, **(self.where | {"detail": detail}))


def _trimmed(coefficients: FloatArray) -> FloatArray:
    """Without the terms above the largest degree, which a plan's curves have as zeros at most."""
    return np.ascontiguousarray(coefficients[:, :, : LARGEST_DEGREE + 1])


def to_point(values: FloatArray) -> Point:
    """Three numbers as a point."""
    x, y, z = values.tolist()
    return x, y, z


#: Least margins are found to this much, on the safe side.
RESOLUTION_M = 1e-7


@dataclass(frozen=True)
class Nearest:
    """The moment at which a plan is tightest.

    Attributes:
        margin: Metres beyond what must be kept; never above the true margin, below it by `RESOLUTION_M` at most
            unless a drone is inside an obstacle.
        time: Seconds.
        place: Metres, where the drone is then.
        drone: Index of the drone.
        other: Index of the obstacle, or of the other drone.
    """

    margin: float
    time: float
    place: Point
    drone: int
    other: int
