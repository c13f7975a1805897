"""The parts of a scene: bounds, drones, tasks, obstacles and where on Earth they are, each checked when made."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

from flockopt.errors import SceneError
from flockopt.geometry.distances import BOX, CYLINDER, OBSTACLE_COLUMNS, SPHERE
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import quantities
from flockopt.scene.quantities import LARGEST_SIDE_M

__all__ = [
    "GRAVITY_MPS2", "LATER_DRONE_KEYS", "SHAPES", "Bounds", "Box", "Cylinder", "Drone", "Obstacle", "Origin", "Point", "Sphere",
    "Task", "obstacle_table",
]  # fmt: skip

#: Standard gravity.
GRAVITY_MPS2 = 9.80665

#: No scene lies higher above the sea than this, or deeper below it.
HIGHEST_M = 1e5

#: Keys younger than the format: scenes that do not use them keep the canonical form, and the digest, they always had.
LATER_DRONE_KEYS = ("mass", "max_thrust", "max_tilt")

Point: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Bounds:
    """The axis-aligned space that drones' centres stay within, metres."""

    lower: Point
    upper: Point

    def __post_init__(self) -> None:
        checks.store(self, quantities.place, SceneError, "lower", "upper")
        for axis, (low, high) in enumerate(zip(self.lower, self.upper, strict=True)):
            if not high > low:
                raise SceneError(f"upper[{axis}]", f"is {high:g}", f"must be > lower[{axis}] = {low:g}", "swap or widen them")
            if high - low > LARGEST_SIDE_M:
                rule = f"must be at most {LARGEST_SIDE_M:g} m from lower[{axis}] = {low:g}"
                raise SceneError(f"upper[{axis}]", f"is {high:g}", rule, "narrow the bounds to where drones fly")


@dataclass(frozen=True)
class Drone:
    """A drone: where it starts, what it carries, how it may fly.

    ``end`` is where its route ends: a point, ``"start"``, or None to hover at its last task. ``velocity`` and
    ``acceleration`` are its state at ``start``, for planning from flight. Limits are on Euclidean norms.
    ``mass`` (kg), ``max_thrust`` (N, of all rotors) and ``max_tilt`` (radians from upright) say what it can do.
    """

    id: str
    start: Point
    capacity: int
    radius: float
    max_speed: float
    max_acceleration: float
    max_jerk: float
    end: Point | str | None = None
    velocity: Point = (0.0, 0.0, 0.0)
    acceleration: Point = (0.0, 0.0, 0.0)
    max_distance: float | None = None
    mass: float | None = None
    max_thrust: float | None = None
    max_tilt: float | None = None

    def __post_init__(self) -> None:
        checks.text(SceneError, "id", self.id)
        mend = "capacities are integers >= 0; set 0 to ground the drone"
        checks.store(self, quantities.place, SceneError, "start")
        checks.store(self, checks.point, SceneError, "velocity", "acceleration")
        checks.store(self, quantities.load, SceneError, "capacity", least=0, mend=mend)
        checks.store(self, quantities.measure, SceneError, "radius", "max_speed", "max_acceleration", "max_jerk")
        if self.max_distance is not None:
            checks.store(self, quantities.positive, SceneError, "max_distance")
        if isinstance(self.end, str) and self.end != "start":
            raise SceneError("end", f"is {checks.shown(self.end)}", 'must be a point, "start" or null', "name a point")
        if self.end is not None and self.end != "start":
            checks.store(self, quantities.place, SceneError, "end")
        self._check_abilities()
        self._check_state("velocity", self.max_speed, "max_speed")
        self._check_state("acceleration", self.max_acceleration, "max_acceleration")

    def _check_abilities(self) -> None:
        given = [name for name in LATER_DRONE_KEYS if getattr(self, name) is not None]
        checks.store(self, quantities.positive, SceneError, *given)
        if self.max_tilt is not None and not self.max_tilt < math.pi / 2:
            mend = "give it in radians, or null; did you mean degrees?"
            raise SceneError("max_tilt", f"is {self.max_tilt:g}", "must be < pi / 2 radians", mend)
        if self.max_thrust is not None and self.mass is None:
            raise SceneError("mass", "is missing", "max_thrust means nothing without it", "give the mass, or no max_thrust")
        if self.max_thrust is not None and self.mass is not None and not self.max_thrust > self.mass * GRAVITY_MPS2:
            rule = f"must be > mass * gravity = {self.mass * GRAVITY_MPS2:.6g} N, to hover"
            raise SceneError("max_thrust", f"is {self.max_thrust:g}", rule, "raise it (newtons, all rotors) or lower the mass")

    def _check_state(self, field: str, limit: float, limit_name: str) -> None:
        norm = math.hypot(*getattr(self, field))
        if norm > limit * (1 + 1e-6):
            raise SceneError(field, f"has norm {norm:g}", f"must be <= {limit_name} = {limit:g}", "slow it or raise the limit")

    @property
    def has_abilities(self) -> bool:
        """Whether anything is known of what its rotors can do."""
        return any(getattr(self, name) is not None for name in LATER_DRONE_KEYS)

    @property
    def flyable_acceleration(self) -> float:
        """Metres per second squared: an acceleration up to it, in any direction, is within every limit.

        With gravity g, thrust leans by asin(a / g) at most and weighs mass * (g + a) at most.
        """
        limits = [self.max_acceleration]
        if self.max_tilt is not None:
            limits.append(GRAVITY_MPS2 * math.sin(self.max_tilt))
        if self.max_thrust is not None and self.mass is not None:
            limits.append(self.max_thrust / self.mass - GRAVITY_MPS2)
        return min(limits)

    @property
    def end_point(self) -> Point | None:
        """Where the route ends, or None when it ends at the last task."""
        return self.start if self.end == "start" else self.end  # type: ignore[return-value]


@dataclass(frozen=True)
class Origin:
    """Where on Earth the scene's (0, 0, 0) is.

    ``latitude`` and ``longitude`` are WGS 84 degrees, ``altitude`` metres above mean sea level, ``heading`` radians
    clockwise from true north to the scene's y axis.
    """

    latitude: float
    longitude: float
    altitude: float
    heading: float = 0.0

    def __post_init__(self) -> None:
        checks.store(self, checks.number, SceneError, "latitude", "longitude", "altitude")
        checks.store(self, quantities.angle, SceneError, "heading")
        checks.number(SceneError, "altitude", abs(self.altitude), most=HIGHEST_M, mend="give it in metres above mean sea level")
        for field, most in (("latitude", 90.0), ("longitude", 180.0)):
            value = getattr(self, field)
            if abs(value) > most:
                raise SceneError(field, f"is {value:g}", f"must be within [-{most:g}, {most:g}] degrees", "correct it")


@dataclass(frozen=True)
class Task:
    """A point to visit once; with ``service_time`` > 0 the drone holds still there for that many seconds."""

    id: str
    position: Point
    demand: int = 1
    service_time: float = 0.0

    def __post_init__(self) -> None:
        checks.text(SceneError, "id", self.id)
        checks.store(self, quantities.place, SceneError, "position")
        checks.store(self, quantities.load, SceneError, "demand", least=1)
        checks.store(self, quantities.seconds, SceneError, "service_time")


@dataclass(frozen=True)
class Box:
    """A box of full ``size``, turned by ``yaw`` radians about the vertical through its centre."""

    id: str
    center: Point
    size: Point
    yaw: float = 0.0
    shape: ClassVar[str] = "box"

    def __post_init__(self) -> None:
        checks.text(SceneError, "id", self.id)
        checks.store(self, quantities.place, SceneError, "center")
        checks.store(self, checks.point, SceneError, "size")
        checks.store(self, quantities.angle, SceneError, "yaw")
        for axis in range(3):
            mend = "remove the obstacle or give it a size"
            quantities.positive(SceneError, f"size[{axis}]", self.size[axis], mend=mend)

    def row(self) -> tuple[float, ...]:
        """Its row in an obstacle table (`flockopt.geometry.distances.OBSTACLE_COLUMNS`)."""
        return (BOX, *self.center, *(side / 2 for side in self.size), math.cos(self.yaw), math.sin(self.yaw))


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder; ``center`` is its geometric centre."""

    id: str
    center: Point
    radius: float
    height: float
    shape: ClassVar[str] = "cylinder"

    def __post_init__(self) -> None:
        checks.text(SceneError, "id", self.id)
        checks.store(self, quantities.place, SceneError, "center")
        checks.store(self, quantities.positive, SceneError, "radius", "height")

    def row(self) -> tuple[float, ...]:
        """Its row in an obstacle table (`flockopt.geometry.distances.OBSTACLE_COLUMNS`)."""
        return (CYLINDER, *self.center, self.radius, self.radius, self.height / 2, 1.0, 0.0)


@dataclass(frozen=True)
class Sphere:
    """A ball."""

    id: str
    center: Point
    radius: float
    shape: ClassVar[str] = "sphere"

    def __post_init__(self) -> None:
        checks.text(SceneError, "id", self.id)
        checks.store(self, quantities.place, SceneError, "center")
        checks.store(self, quantities.positive, SceneError, "radius")

    def row(self) -> tuple[float, ...]:
        """Its row in an obstacle table (`flockopt.geometry.distances.OBSTACLE_COLUMNS`)."""
        return (SPHERE, *self.center, self.radius, self.radius, self.radius, 1.0, 0.0)


Obstacle: TypeAlias = Box | Cylinder | Sphere
SHAPES: dict[str, type[Box] | type[Cylinder] | type[Sphere]] = {kind.shape: kind for kind in (Box, Cylinder, Sphere)}


def obstacle_table(obstacles: Iterable[Box | Cylinder | Sphere]) -> FloatArray:
    """The obstacles as a read-only (K, 9) table, one row each, columns as in `OBSTACLE_COLUMNS`."""
    rows = [obstacle.row() for obstacle in obstacles]
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(OBSTACLE_COLUMNS))
    table.setflags(write=False)
    return table
