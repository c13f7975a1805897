"""Scenes: drones, tasks and obstacles, validated when made and never changed after.

The file format is ``flockopt.scene/1`` (see docs/formats.md). Every record checks itself on construction, so
that a `Scene` in hand is a scene that can be planned; `Scene.replace` makes an edited copy, checked again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np

from flockopt import reading
from flockopt.errors import SceneError
from flockopt.geometry import BOX, CYLINDER, SPHERE, FloatArray, bounding_boxes, distances, obstacle_table

__all__ = ["Bounds", "Box", "Cylinder", "Drone", "Obstacle", "Scene", "Sphere", "Task"]

FORMAT = "flockopt.scene/1"

#: Slack in comparisons of validated positions, metres: what is lost when a file is written and read again.
POSITION_TOLERANCE_M = 1e-9

Point: TypeAlias = tuple[float, float, float]


def _set(record: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(record, name, value)


def _positive(record: object, *fields: str) -> None:
    for field in fields:
        _set(record, **{field: reading.number(SceneError, field, getattr(record, field), above=0.0)})


@dataclass(frozen=True)
class Bounds:
    """The axis-aligned space that drones' centres stay within, metres."""

    lower: Point
    upper: Point

    def __post_init__(self) -> None:
        _set(self, lower=reading.point(SceneError, "lower", self.lower), upper=reading.point(SceneError, "upper", self.upper))
        for axis, (low, high) in enumerate(zip(self.lower, self.upper, strict=True)):
            if not high > low:
                raise SceneError(f"upper[{axis}]", f"is {high:g}", f"must be > lower[{axis}] = {low:g}", "swap or widen them")


@dataclass(frozen=True)
class Drone:
    """A drone: where it starts, what it carries, how it may fly.

    ``end`` is where its route ends: a point, ``"start"``, or None to hover at its last task. ``velocity`` and
    ``acceleration`` are its state at ``start``, for planning from flight. Limits are on Euclidean norms.
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

    def __post_init__(self) -> None:
        reading.text(SceneError, "id", self.id)
        mend = "capacities are integers >= 0; set 0 to ground the drone"
        _set(
            self,
            start=reading.point(SceneError, "start", self.start),
            capacity=reading.integer(SceneError, "capacity", self.capacity, least=0, mend=mend),
            velocity=reading.point(SceneError, "velocity", self.velocity),
            acceleration=reading.point(SceneError, "acceleration", self.acceleration),
        )
        _positive(self, "radius", "max_speed", "max_acceleration", "max_jerk")
        if self.max_distance is not None:
            _positive(self, "max_distance")
        if isinstance(self.end, str) and self.end != "start":
            raise SceneError("end", f"is {reading.shown(self.end)}", 'must be a point, "start" or null', "name a point")
        if self.end is not None and self.end != "start":
            _set(self, end=reading.point(SceneError, "end", self.end))
        self._check_state("velocity", self.max_speed, "max_speed")
        self._check_state("acceleration", self.max_acceleration, "max_acceleration")

    def _check_state(self, field: str, limit: float, limit_name: str) -> None:
        norm = math.hypot(*getattr(self, field))
        if norm > limit * (1 + 1e-6):
            raise SceneError(field, f"has norm {norm:g}", f"must be <= {limit_name} = {limit:g}", "slow it or raise the limit")

    @property
    def end_point(self) -> Point | None:
        """Where the route ends, or None when it ends at the last task."""
        return self.start if self.end == "start" else self.end  # type: ignore[return-value]


@dataclass(frozen=True)
class Task:
    """A point to visit once; with ``service_time`` > 0 the drone holds still there for that many seconds."""

    id: str
    position: Point
    demand: int = 1
    service_time: float = 0.0

    def __post_init__(self) -> None:
        reading.text(SceneError, "id", self.id)
        _set(
            self,
            position=reading.point(SceneError, "position", self.position),
            demand=reading.integer(SceneError, "demand", self.demand, least=1),
            service_time=reading.number(SceneError, "service_time", self.service_time, least=0.0),
        )


@dataclass(frozen=True)
class Box:
    """A box of full ``size``, turned by ``yaw`` radians about the vertical through its centre."""

    id: str
    center: Point
    size: Point
    yaw: float = 0.0
    shape: ClassVar[str] = "box"

    def __post_init__(self) -> None:
        reading.text(SceneError, "id", self.id)
        _set(
            self,
            center=reading.point(SceneError, "center", self.center),
            size=reading.point(SceneError, "size", self.size),
            yaw=reading.number(SceneError, "yaw", self.yaw),
        )
        for axis in range(3):
            mend = "remove the obstacle or give it a size"
            reading.number(SceneError, f"size[{axis}]", self.size[axis], above=0.0, mend=mend)

    def row(self) -> tuple[float, ...]:
        """Its row in an obstacle table (`flockopt.geometry.OBSTACLE_COLUMNS`)."""
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
        reading.text(SceneError, "id", self.id)
        _set(self, center=reading.point(SceneError, "center", self.center))
        _positive(self, "radius", "height")

    def row(self) -> tuple[float, ...]:
        """Its row in an obstacle table (`flockopt.geometry.OBSTACLE_COLUMNS`)."""
        return (CYLINDER, *self.center, self.radius, self.radius, self.height / 2, 1.0, 0.0)


@dataclass(frozen=True)
class Sphere:
    """A ball."""

    id: str
    center: Point
    radius: float
    shape: ClassVar[str] = "sphere"

    def __post_init__(self) -> None:
        reading.text(SceneError, "id", self.id)
        _set(self, center=reading.point(SceneError, "center", self.center))
        _positive(self, "radius")

    def row(self) -> tuple[float, ...]:
        """Its row in an obstacle table (`flockopt.geometry.OBSTACLE_COLUMNS`)."""
        return (SPHERE, *self.center, self.radius, self.radius, self.radius, 1.0, 0.0)


Obstacle: TypeAlias = Box | Cylinder | Sphere
SHAPES: dict[str, type[Box] | type[Cylinder] | type[Sphere]] = {kind.shape: kind for kind in (Box, Cylinder, Sphere)}


@dataclass(frozen=True)
class Scene:
    """Everything a fleet plan is made for: see docs/formats.md for each field's meaning and unit.

    Raises:
        SceneError: Naming the field, the value, the rule and the mend.
    """

    name: str
    bounds: Bounds
    drones: tuple[Drone, ...]
    tasks: tuple[Task, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    clearance: float = 0.0
    separation: float = 0.0
    separation_z: float | None = None

    def __post_init__(self) -> None:
        reading.text(SceneError, "name", self.name)
        _set(
            self,
            drones=tuple(self.drones), tasks=tuple(self.tasks), obstacles=tuple(self.obstacles),
            clearance=reading.number(SceneError, "clearance", self.clearance, least=0.0),
            separation=reading.number(SceneError, "separation", self.separation, least=0.0),
        )  # fmt: skip
        if self.separation_z is not None:
            _positive(self, "separation_z")
            if self.separation == 0.0:
                raise SceneError("separation", "is 0", "must be > 0 where separation_z is given", "give both or neither")
        if not self.drones:
            raise SceneError("drones", "is empty", "a fleet has at least one drone", "add a drone")
        for field in ("drones", "tasks", "obstacles"):
            reading.unique(SceneError, field, [record.id for record in getattr(self, field)])
        with np.errstate(over="ignore", invalid="ignore"):  # what is 1e300 m away is far, and no reason for a warning
            self._check_places()
            self._check_starts_apart()

    # -- arrays, made once and read-only --------------------------------------------------------------------

    @property
    def num_drones(self) -> int:
        """N."""
        return len(self.drones)

    @property
    def num_tasks(self) -> int:
        """M."""
        return len(self.tasks)

    @cached_property
    def starts(self) -> FloatArray:
        """(N, 3) m."""
        return _frozen([drone.start for drone in self.drones], 3)

    @cached_property
    def ends(self) -> FloatArray:
        """(N, 3) m; NaN where a route ends at its last task."""
        return _frozen([drone.end_point or (math.nan,) * 3 for drone in self.drones], 3)

    @cached_property
    def task_positions(self) -> FloatArray:
        """(M, 3) m."""
        return _frozen([task.position for task in self.tasks], 3)

    @cached_property
    def capacities(self) -> FloatArray:
        """(N,) total demand each drone can serve."""
        return _frozen([drone.capacity for drone in self.drones])

    @cached_property
    def demands(self) -> FloatArray:
        """(M,)."""
        return _frozen([task.demand for task in self.tasks])

    @cached_property
    def radii(self) -> FloatArray:
        """(N,) m."""
        return _frozen([drone.radius for drone in self.drones])

    @cached_property
    def obstacle_table(self) -> FloatArray:
        """(K, 9), see `flockopt.geometry.OBSTACLE_COLUMNS`."""
        return obstacle_table(self.obstacles)

    @cached_property
    def obstacle_boxes(self) -> FloatArray:
        """(K, 2, 3) m, the obstacles' axis-aligned bounding boxes."""
        return bounding_boxes(self.obstacle_table)

    @property
    def separation_axes(self) -> Point:
        """Half axes of the ellipsoid around a drone that other drones' centres stay out of, metres."""
        return (self.separation, self.separation, self.separation if self.separation_z is None else self.separation_z)

    # -- files ----------------------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene file.

        Raises:
            SceneError: If the file cannot be read or is not a valid ``flockopt.scene/1``.
        """
        return cls.from_dict(reading.read_json(SceneError, path))

    @classmethod
    def from_dict(cls, record: Any) -> Scene:
        """A scene from its JSON object, read strictly."""
        if isinstance(record, dict) and record.get("format", FORMAT) != FORMAT:
            raise SceneError("format", f"is {reading.shown(record['format'])}", f'must be "{FORMAT}"', "convert the file")
        fields = reading.keys(SceneError, record, ("format", *_required(cls)), _optional(cls))
        values = {key: value for key, value in fields.items() if key != "format"}
        try:
            values["bounds"] = _from_fields(Bounds, values["bounds"])
        except SceneError as fault:
            raise fault.within("bounds") from None
        values["drones"] = reading.objects(SceneError, "drones", values["drones"], lambda item: _from_fields(Drone, item))
        values["tasks"] = reading.objects(SceneError, "tasks", values["tasks"], lambda item: _from_fields(Task, item))
        values["obstacles"] = reading.objects(SceneError, "obstacles", values["obstacles"], _obstacle)
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """The canonical JSON object: every default filled in."""
        record = dataclasses.asdict(self)
        record["obstacles"] = [{"shape": kind.shape, **dataclasses.asdict(kind)} for kind in self.obstacles]
        return {"format": FORMAT, **json.loads(json.dumps(record))}

    def save(self, path: str | Path) -> None:
        """Write a scene file, whole or not at all."""
        reading.write_whole(SceneError, path, json.dumps(self.to_dict(), indent=1) + "\n")

    @cached_property
    def sha256(self) -> str:
        """Digest of the canonical form: sorted keys, no spaces, defaults filled in."""
        canonical = json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return hashlib.sha256(canonical.encode("utf-8")).hexdigest()

    def replace(self, **changes: Any) -> Scene:
        """A copy with some fields changed, validated anew."""
        return dataclasses.replace(self, **changes)

    # -- checks that need the whole scene -------------------------------------------------------------------

    def _check_places(self) -> None:
        smallest = min(drone.radius for drone in self.drones)
        places = [(f"drones[{i}].start", drone.start, drone.radius) for i, drone in enumerate(self.drones)]
        places += [
            (f"drones[{i}].end", drone.end, drone.radius)
            for i, drone in enumerate(self.drones)
            if drone.end is not None and drone.end != "start"
        ]
        places += [(f"tasks[{j}].position", task.position, smallest) for j, task in enumerate(self.tasks)]
        points = np.array([place for _, place, _ in places])
        gaps = distances(self.obstacle_table, points)  # (P, K)
        for (field, place, radius), gap in zip(places, gaps, strict=True):
            for axis, (low, value, high) in enumerate(zip(self.bounds.lower, place, self.bounds.upper, strict=True)):
                if not low <= value <= high:
                    rule = f"must be within bounds [{low:g}, {high:g}]"
                    raise SceneError(f"{field}[{axis}]", f"is {value:g}", rule, "move it")
            need = radius + self.clearance
            if gap.size and gap.min() < need - POSITION_TOLERANCE_M:
                culprit = self.obstacles[int(gap.argmin())].id
                raise SceneError(
                    field, f"is {gap.min():.4g} m from obstacle {reading.shown(culprit)}",
                    f"must be >= radius + clearance = {need:g} m away", "move it or the obstacle",
                )  # fmt: skip

    def _check_starts_apart(self) -> None:
        if self.separation == 0.0:
            return
        scaled = self.starts / np.array(self.separation_axes)
        for i in range(1, len(scaled)):
            apart = np.linalg.norm(scaled[:i] - scaled[i], axis=1)
            j = int(apart.argmin())
            if apart[j] < 1 - POSITION_TOLERANCE_M:
                metres = math.dist(self.drones[i].start, self.drones[j].start)
                raise SceneError(
                    f"drones[{i}].start", f"is {metres:.4g} m from drones[{j}].start",
                    f"starts must be at least the separation apart ({self.separation:g} m)", "move one of them",
                )  # fmt: skip


def _frozen(values: list[Any], width: int | None = None) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    if width is not None:
        array = array.reshape(-1, width)
    array.setflags(write=False)
    return array


def _required(record: type) -> tuple[str, ...]:
    missing = dataclasses.MISSING
    names = tuple(field.name for field in dataclasses.fields(record) if field.default is missing)
    return (*names, "tasks", "obstacles") if record is Scene else names


def _optional(record: type) -> tuple[str, ...]:
    required = _required(record)
    return tuple(field.name for field in dataclasses.fields(record) if field.name not in required)


def _from_fields(record: type, item: Any) -> Any:
    return record(**reading.keys(SceneError, item, _required(record), _optional(record)))


def _obstacle(item: Any) -> Obstacle:
    if not isinstance(item, dict):
        raise SceneError("", f"is {reading.shown(item)}", "must be an object", "put it in braces")
    if "shape" not in item:
        raise SceneError("shape", "is missing", "the key is required", "add it")
    kind = SHAPES.get(item["shape"]) if isinstance(item["shape"], str) else None
    if kind is None:
        raise SceneError("shape", f"is {reading.shown(item['shape'])}", f"must be one of {', '.join(SHAPES)}", "choose one")
    return _from_fields(kind, {key: value for key, value in item.items() if key != "shape"})
