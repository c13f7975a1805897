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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from flockopt.errors import SceneError
from flockopt.geometry.distances import bounding_boxes, distances
from flockopt.records import checks, files
from flockopt.records.arrays import FloatArray, IntArray
from flockopt.scene import quantities
from flockopt.scene.parts import (
    GRAVITY_MPS2,
    LATER_DRONE_KEYS,
    SHAPES,
    Bounds,
    Box,
    Cylinder,
    Drone,
    Obstacle,
    Origin,
    Point,
    Sphere,
    Task,
    obstacle_table,
)

if TYPE_CHECKING:
    from flockopt.geometry.free_space import FreeSpace

__all__ = [
    "GRAVITY_MPS2", "Bounds", "Box", "Cylinder", "Drone", "Obstacle", "Origin", "Point", "Scene", "Sphere", "Task",
]  # fmt: skip

FORMAT = "flockopt.scene/1"

#: Slack in comparisons of validated positions, metres: what is lost when a file is written and read again.
POSITION_TOLERANCE_M = 1e-9

#: Younger than the format, as `scene_parts.LATER_DRONE_KEYS` are.
LATER_SCENE_KEYS = ("origin",)


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
    origin: Origin | None = None

    def __post_init__(self) -> None:
        checks.text(SceneError, "name", self.name)
        for field in ("drones", "tasks", "obstacles"):
            object.__setattr__(self, field, tuple(getattr(self, field)))
        checks.store(self, quantities.width, SceneError, "clearance", "separation")
        if not self.drones:
            raise SceneError("drones", "is empty", "a fleet has at least one drone", "add a drone")
        if self.separation_z is not None:
            checks.store(self, quantities.measure, SceneError, "separation_z")
            if self.separation == 0.0:
                raise SceneError("separation", "is 0", "must be > 0 where separation_z is given", "give both or neither")
            bodies = sum(sorted(drone.radius for drone in self.drones)[-2:])
            if len(self.drones) > 1 and self.separation_z < bodies:
                rule = f"must be >= the radii of the two largest drones together = {bodies:g} m, or bodies could overlap"
                raise SceneError("separation_z", f"is {self.separation_z:g}", rule, "raise it, or leave it out")
        for field in ("drones", "tasks", "obstacles"):
            checks.unique(SceneError, field, [record.id for record in getattr(self, field)])
        for kind, field, records in (("tasks", "demand", self.tasks), ("drones", "capacity", self.drones)):
            total = sum(getattr(record, field) for record in records)
            if total > quantities.MOST_DEMAND:
                rule = f"all {field} together must be <= 2**53 = {quantities.MOST_DEMAND}, to be added exactly"
                raise SceneError(kind, f"have a {field} of {total} in all", rule, "count in larger units")
        self._check_places()
        self._check_starts_apart()
        self._check_ends_apart()

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
        """(K, 9), see `flockopt.geometry.distances.OBSTACLE_COLUMNS`."""
        return obstacle_table(self.obstacles)

    @cached_property
    def obstacle_boxes(self) -> FloatArray:
        """(K, 2, 3) m, the obstacles' axis-aligned bounding boxes."""
        return bounding_boxes(self.obstacle_table)

    def free_space(self, needs: ArrayLike) -> FreeSpace:
        """Where a drone's centre may be that keeps ``needs`` metres, (K,) or one number, from the obstacles."""
        from flockopt.geometry.free_space import free_space

        return free_space(self.obstacle_table, needs, (self.bounds.lower, self.bounds.upper), self.obstacle_boxes)

    def axes_between(self, one: int | IntArray, other: int | IntArray) -> FloatArray:
        """Half axes of the ellipsoid around a drone that another drone's centre stays out of, (..., 3) m.

        They are the separation's, or the sum of the two radii where that is more: bodies never overlap, whatever a scene asks.

        Args:
            one: Indices of drones.
            other: Of the others, of a shape that goes with it.
        """
        bodies = np.asarray(self.radii[one]) + np.asarray(self.radii[other])
        flat = np.maximum(self.separation, bodies)
        tall = flat if self.separation_z is None else np.full_like(flat, self.separation_z)
        return np.stack([flat, flat, tall], axis=-1)

    def apart_in_words(self, one: int, other: int) -> str:
        """What two drones keep between their centres, for people."""
        flat, _, tall = self.axes_between(one, other)
        if flat > self.separation:
            return f"at least the sum of their radii ({flat:g} m)"
        return f"at least the separation ({flat:g} m{'' if tall == flat else f', {tall:g} m upwards'})"

    @cached_property
    def widest_axes(self) -> FloatArray:
        """(3,) m, half axes that hold those between any two drones: what keeps the two largest apart."""
        largest = np.argsort(self.radii)[-2:]
        axes = self.axes_between(largest[0], largest[-1])
        axes.setflags(write=False)
        return axes

    # -- files ----------------------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene file.

        Raises:
            SceneError: If the file cannot be read or is not a valid ``flockopt.scene/1``.
        """
        return cls.from_dict(files.read_json(SceneError, path))

    @classmethod
    def from_dict(cls, record: Any) -> Scene:
        """A scene from its JSON object, read strictly."""
        if isinstance(record, dict) and record.get("format", FORMAT) != FORMAT:
            raise SceneError("format", f"is {checks.shown(record['format'])}", f'must be "{FORMAT}"', "convert the file")
        fields = checks.keys(SceneError, record, ("format", *_required(cls)), _optional(cls))
        values = {key: value for key, value in fields.items() if key != "format"}
        values["bounds"] = _nested("bounds", Bounds, values["bounds"])
        if values.get("origin") is not None:
            values["origin"] = _nested("origin", Origin, values["origin"])
        values["drones"] = checks.objects(SceneError, "drones", values["drones"], lambda item: _from_fields(Drone, item))
        values["tasks"] = checks.objects(SceneError, "tasks", values["tasks"], lambda item: _from_fields(Task, item))
        values["obstacles"] = checks.objects(SceneError, "obstacles", values["obstacles"], _obstacle)
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """The canonical JSON object: every default filled in, but for unused keys that are younger than the format."""
        record = _fields_of(self) | {"bounds": _fields_of(self.bounds)}
        record |= {name: [_fields_of(item) for item in record[name]] for name in ("drones", "tasks")}
        record["origin"] = None if self.origin is None else _fields_of(self.origin)
        for owner, names in ((record, LATER_SCENE_KEYS), *((drone, LATER_DRONE_KEYS) for drone in record["drones"])):
            for name in names:
                if owner[name] is None:
                    del owner[name]
        record["obstacles"] = [{"shape": kind.shape, **_fields_of(kind)} for kind in self.obstacles]
        return {"format": FORMAT, **json.loads(json.dumps(record))}

    def save(self, path: str | Path) -> None:
        """Write a scene file, whole or not at all."""
        files.write_whole(SceneError, path, json.dumps(self.to_dict(), indent=1) + "\n")

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
            (f"drones[{i}].end", drone.end, drone.radius) for i, drone in enumerate(self.drones) if isinstance(drone.end, tuple)
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
                    field, f"is {gap.min():.4g} m from obstacle {checks.shown(culprit)}",
                    f"must be >= radius + clearance = {need:g} m away", "move it or the obstacle",
                )  # fmt: skip

    def _check_ends_apart(self) -> None:
        """Ends, those at drones' starts included, at which two drones cannot both rest."""
        with_end = np.flatnonzero(~np.isnan(self.ends[:, 0]))
        for rank, i in list(enumerate(with_end.tolist()))[1:]:
            others = with_end[:rank]
            apart = np.linalg.norm((self.ends[others] - self.ends[i]) / self.axes_between(others, i), axis=1)
            if apart.min() < 1 - POSITION_TOLERANCE_M:
                j = int(others[int(apart.argmin())])
                raise SceneError(
                    f"drones[{i}].end", f"is {math.dist(self.ends[i], self.ends[j]):.4g} m from drones[{j}].end",
                    f"ends must be {self.apart_in_words(i, j)} apart, for both drones rest there", "move one of them",
                )  # fmt: skip

    def _check_starts_apart(self) -> None:
        for i in range(1, self.num_drones):
            apart = np.linalg.norm((self.starts[:i] - self.starts[i]) / self.axes_between(np.arange(i), i), axis=1)
            j = int(apart.argmin())
            if apart[j] < 1 - POSITION_TOLERANCE_M:
                metres, need = math.dist(self.drones[i].start, self.drones[j].start), float(self.axes_between(i, j)[0])
                rule = f"starts must be apart by the separation and by both radii: {need:g} m"
                raise SceneError(f"drones[{i}].start", f"is {metres:.4g} m from drones[{j}].start", rule, "move one of them")


def _frozen(values: list[Any], width: int | None = None) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    if width is not None:
        array = array.reshape(-1, width)
    array.setflags(write=False)
    return array


def _fields_of(record: Any) -> dict[str, Any]:
    """A record's fields by name, as they are: many times as fast as `dataclasses.asdict`, which copies all that they hold."""
    return {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}


def _required(record: type) -> tuple[str, ...]:
    missing = dataclasses.MISSING
    names = tuple(field.name for field in dataclasses.fields(record) if field.default is missing)
    return (*names, "tasks", "obstacles") if record is Scene else names


def _optional(record: type) -> tuple[str, ...]:
    required = _required(record)
    return tuple(field.name for field in dataclasses.fields(record) if field.name not in required)


def _from_fields(record: type, item: Any) -> Any:
    return record(**checks.keys(SceneError, item, _required(record), _optional(record)))


def _nested(field: str, record: type, item: Any) -> Any:
    try:
        return _from_fields(record, item)
    except SceneError as fault:
        raise fault.within(field) from None


def _obstacle(item: Any) -> Obstacle:
    if not isinstance(item, dict):
        raise SceneError("", f"is {checks.shown(item)}", "must be an object", "put it in braces")
    if "shape" not in item:
        raise SceneError("shape", "is missing", "the key is required", "add it")
    kind = SHAPES.get(item["shape"]) if isinstance(item["shape"], str) else None
    if kind is None:
        raise SceneError("shape", f"is {checks.shown(item['shape'])}", f"must be one of {', '.join(SHAPES)}", "choose one")
    return _from_fields(kind, {key: value for key, value in item.items() if key != "shape"})
