"""Demonstrations in files: flat arrays of many scenes in ``shard-00000.npz`` and so on, read strictly, without pickle.

Scenes differ in size, so what belongs to drones, tasks and obstacles stands in one row for all scenes of a shard, and
``*_offsets`` say where each scene's part begins. docs/demonstrations.md lists every array.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt import reading
from flockopt.bundles import Bundles
from flockopt.errors import SettingsError
from flockopt.geometry import BOX, CYLINDER, FloatArray
from flockopt.scene import Bounds, Box, Cylinder, Drone, Obstacle, Scene, Sphere, Task
from learned.rollout import Rollout

__all__ = ["Demonstration", "Demonstrations", "load_demonstrations", "pack", "shard_path", "write_shard"]

FORMAT = "flockopt.demonstrations/1"

Arrays = dict[str, NDArray[Any]]

#: Name, kind of number and shape of every array: S scenes; N drones, M tasks and K obstacles of all of them; V vertices of
#: all their paths; T samples.
LAYOUT: dict[str, tuple[type[np.generic], tuple[int | str, ...]]] = {
    "seed": (np.int64, ("S",)), "family": (np.str_, ("S",)), "hard": (np.bool_, ("S",)),
    "bounds": (np.float64, ("S", 2, 3)), "clearance": (np.float64, ("S",)), "separation": (np.float64, ("S",)),
    "teacher_cost": (np.float64, ("S",)),
    "drone_offsets": (np.int64, ("S+1",)), "task_offsets": (np.int64, ("S+1",)), "obstacle_offsets": (np.int64, ("S+1",)),
    "starts": (np.float64, ("N", 3)), "capacities": (np.int64, ("N",)), "radii": (np.float64, ("N",)),
    "limits": (np.float64, ("N", 3)), "teacher_samples": (np.float32, ("N", "T", 3)),
    "tasks": (np.float64, ("M", 3)), "demands": (np.int64, ("M",)),
    "teacher_drone": (np.int64, ("M",)), "teacher_rank": (np.int64, ("M",)), "teacher_place": (np.int64, ("M",)),
    "obstacles": (np.float64, ("K", 9)),
    "vertex_offsets": (np.int64, ("N+1",)), "teacher_vertices": (np.float64, ("V", 3)), "teacher_stops": (np.int64, ("V",)),
}  # fmt: skip

#: An array to tell the length of each axis by.
LEADERS = {"S": "seed", "N": "starts", "M": "tasks", "K": "obstacles", "V": "teacher_stops"}

#: Where parts begin, and on which axis.
OFFSETS = {"drone_offsets": "N", "task_offsets": "M", "obstacle_offsets": "K", "vertex_offsets": "V"}

#: How far a sample may be from the task it stands for, metres: what single precision loses.
ANCHOR_TOLERANCE_M = 1e-3


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One scene with what the teacher did in it; teacher_* are the paper's starred quantities.

    Attributes:
        seed: Of the scene.
        family: Its family.
        hard: Whether the bundles are random, so that they are no example for the allocation.
        bounds: (2, 3) m.
        clearance: m.
        separation: m.
        starts: (N, 3) m.
        capacities: (N,).
        radii: (N,) m.
        limits: (N, 3) m/s, m/s², m/s³.
        tasks: (M, 3) m.
        demands: (M,).
        obstacles: (K, 9), see `flockopt.geometry.OBSTACLE_COLUMNS`.
        teacher_cost: Metres flown along the legs.
        teacher_drone: (M,) which drone serves a task, -1 for none.
        teacher_rank: (M,) as its how manieth, from 0; -1 for none.
        teacher_place: (M,) at which sample it is there; -1 for none.
        teacher_samples: (N, T, 3) m.
        teacher_paths: For each drone the (V, 3) m vertices of its legs, one after another.
        teacher_stops: For each drone (V,) which task a vertex is, -1 for none.
    """

    seed: int
    family: str
    hard: bool
    bounds: FloatArray
    clearance: float
    separation: float
    starts: FloatArray
    capacities: NDArray[np.int64]
    radii: FloatArray
    limits: FloatArray
    tasks: FloatArray
    demands: NDArray[np.int64]
    obstacles: FloatArray
    teacher_cost: float
    teacher_drone: NDArray[np.int64]
    teacher_rank: NDArray[np.int64]
    teacher_place: NDArray[np.int64]
    teacher_samples: NDArray[np.float32]
    teacher_paths: tuple[FloatArray, ...]
    teacher_stops: tuple[NDArray[np.int64], ...]

    def scene(self) -> Scene:
        """The scene itself."""
        limits = zip(self.starts.tolist(), self.capacities.tolist(), self.radii.tolist(), self.limits.tolist(), strict=True)
        demands = zip(self.tasks.tolist(), self.demands.tolist(), strict=True)
        return Scene(
            name=f"{self.family}-{len(self.starts)}x{len(self.tasks)}-{self.seed}",
            bounds=Bounds(*map(tuple, self.bounds.tolist())),
            drones=tuple(
                Drone(f"d{i}", tuple(start), capacity, radius, *most)
                for i, (start, capacity, radius, most) in enumerate(limits)
            ),
            tasks=tuple(Task(f"t{j}", tuple(place), demand) for j, (place, demand) in enumerate(demands)),
            obstacles=tuple(_obstacle(f"o{k}", row) for k, row in enumerate(self.obstacles.tolist())),
            clearance=float(self.clearance),
            separation=float(self.separation),
        )

    @property
    def teacher_assignment(self) -> NDArray[np.bool_]:
        """A*: (N, M), true where drone i serves task j."""
        return np.arange(len(self.starts))[:, None] == self.teacher_drone[None]

    @property
    def teacher_bundles(self) -> Bundles:
        """B*."""
        order = np.argsort(self.teacher_rank, kind="stable")
        routes = (order[self.teacher_drone[order] == drone] for drone in range(len(self.starts)))
        return Bundles(tuple(tuple(int(task) for task in route) for route in routes))


def _obstacle(name: str, row: list[float]) -> Obstacle:
    """An obstacle from its row in a table (`flockopt.geometry.OBSTACLE_COLUMNS`)."""
    shape, x, y, z, half_x, half_y, half_z, cos_yaw, sin_yaw = row
    if shape == BOX:
        return Box(name, (x, y, z), (2 * half_x, 2 * half_y, 2 * half_z), math.atan2(sin_yaw, cos_yaw))
    return Cylinder(name, (x, y, z), half_x, 2 * half_z) if shape == CYLINDER else Sphere(name, (x, y, z), half_x)


@dataclass(frozen=True, eq=False)
class Demonstrations(Sequence[Demonstration]):
    """Many demonstrations, in flat arrays (docs/demonstrations.md)."""

    arrays: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.arrays["seed"])

    def __getitem__(self, index: Any) -> Any:
        """One demonstration, its arrays being views."""
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        index = int(index) % len(self)
        cut = self._cuts[index]
        parts = {name: self.arrays[name][cut[axes[0]]] for name, (_, axes) in LAYOUT.items() if axes[0] in cut}
        at = self.arrays["vertex_offsets"][cut["N"].start : cut["N"].stop + 1]
        for field, name in (("teacher_paths", "teacher_vertices"), ("teacher_stops", "teacher_stops")):
            parts[field] = tuple(self.arrays[name][begin:end] for begin, end in pairwise(at))
        return Demonstration(**parts)

    @property
    def num_samples(self) -> int:
        """T."""
        return int(self.arrays["teacher_samples"].shape[1])

    @cached_property
    def _cuts(self) -> list[dict[int | str, Any]]:
        """Where each scene's entries are, by the axis they stand on."""
        bounds = [self.arrays[name] for name, axis in OFFSETS.items() if axis in "NMK"]
        return [
            {"S": index, **{axis: slice(at[index], at[index + 1]) for axis, at in zip("NMK", bounds, strict=True)}}
            for index in range(len(self))
        ]


def pack(scenes: Sequence[tuple[int, str, bool, Scene, Bundles, Rollout]]) -> Arrays:
    """The arrays of a shard, from seed, family, hardness, scene, bundles and rollout of each scene."""
    rows = [_record(*scene) for scene in scenes]
    arrays: Arrays = {}
    for name, (kind, axes) in LAYOUT.items():
        if name in OFFSETS:
            sizes = np.concatenate([np.atleast_1d(row[name]) for row in rows])
            arrays[name] = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        elif axes[0] == "S":
            arrays[name] = np.array([row[name] for row in rows], dtype=kind)
        else:
            arrays[name] = np.concatenate([row[name] for row in rows]).astype(kind)
    return arrays


def _record(seed: int, family: str, hard: bool, scene: Scene, bundles: Bundles, rollout: Rollout) -> dict[str, Any]:
    visits = np.full((3, scene.num_tasks), -1)  # drone, rank, place
    for drone, (route, places) in enumerate(zip(bundles, rollout.places, strict=True)):
        visits[:, list(route)] = np.full(len(route), drone), np.arange(len(route)), places
    limits = [(drone.max_speed, drone.max_acceleration, drone.max_jerk) for drone in scene.drones]
    return {
        "seed": seed, "family": family, "hard": hard, "bounds": (scene.bounds.lower, scene.bounds.upper),
        "clearance": scene.clearance, "separation": scene.separation, "teacher_cost": rollout.length,
        "starts": scene.starts, "capacities": scene.capacities, "radii": scene.radii, "limits": limits,
        "teacher_samples": rollout.samples, "tasks": scene.task_positions, "demands": scene.demands,
        "teacher_drone": visits[0], "teacher_rank": visits[1], "teacher_place": visits[2],
        "obstacles": scene.obstacle_table, "drone_offsets": scene.num_drones, "task_offsets": scene.num_tasks,
        "obstacle_offsets": len(scene.obstacles), "vertex_offsets": [len(path) for path in rollout.paths],
        "teacher_vertices": np.concatenate(rollout.paths), "teacher_stops": np.concatenate(rollout.stops),
    }  # fmt: skip


def shard_path(folder: Path, number: int) -> Path:
    """Where a shard is."""
    return folder / f"shard-{number:05d}.npz"


def write_shard(path: Path, arrays: Arrays) -> None:
    """Write a shard, whole or not at all; equal arrays give equal bytes."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, format=np.array(FORMAT), **arrays)
    reading.write_whole(SettingsError, path, content.getvalue())


def load_demonstrations(folder: str | Path) -> Demonstrations:
    """All demonstrations in a folder, those of a run that was stopped too.

    Raises:
        SettingsError: If there are none, or a shard is damaged or not ours; the message names it.
    """
    paths = sorted(Path(folder).glob("shard-*.npz"))
    if not paths:
        rule = "must be a folder with shards"
        raise SettingsError("data", f"{folder} has none", rule, "make some with python -m learned.demonstrations")
    shards = [read_shard(path) for path in paths]
    arrays: Arrays = {}
    for name in LAYOUT:
        parts = [shard[name] for shard in shards]
        if name in OFFSETS:
            ends = np.cumsum([part[-1] for part in parts])
            parts = [np.zeros(1, dtype=np.int64), *(part[1:] + end - part[-1] for part, end in zip(parts, ends, strict=True))]
        elif any(part.shape[1:] != parts[0].shape[1:] for part in parts):
            seen = f"in {folder} has {sorted({part.shape[1] for part in parts})} samples"
            raise SettingsError(name, seen, "all shards must have as many", "keep one run in a folder")
        arrays[name] = np.concatenate(parts)
    return Demonstrations(arrays)


def read_shard(path: Path) -> Arrays:
    """The arrays of one shard.

    Raises:
        SettingsError: Naming the file, and the array where it is one.
    """
    rule, mend = f"must be a shard of format {FORMAT}", "delete it and run learned.demonstrations again"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as fault:
        raise SettingsError("data", f"{path} cannot be read ({fault})", rule, mend) from None
    found = arrays.pop("format", None)
    if found is None or str(found) != FORMAT or set(arrays) != set(LAYOUT):
        seen = f"{path} holds {reading.shown(sorted(arrays))} of format {reading.shown(None if found is None else str(found))}"
        raise SettingsError("data", seen, rule, mend)
    for name, complaint in _faults(arrays):
        raise SettingsError(f"data: {path}: {name}", complaint, rule, mend)
    return arrays


def _faults(arrays: Arrays) -> Iterator[tuple[str, str]]:
    """What is wrong with arrays of the right names: shapes, kinds, then what they mean."""
    sizes: dict[int | str, int] = {axis: len(arrays[name]) for axis, name in LEADERS.items()}
    samples = arrays["teacher_samples"]
    sizes |= {"S+1": sizes["S"] + 1, "N+1": sizes["N"] + 1, "T": samples.shape[1] if samples.ndim == 3 else -1}
    for name, (kind, axes) in LAYOUT.items():
        array, shape = arrays[name], tuple(sizes.get(axis, axis) for axis in axes)
        if not np.issubdtype(array.dtype, kind) or array.shape != shape:
            yield name, f"is {array.dtype} {array.shape}, not {kind.__name__} {shape}"
            return
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            yield name, f"is not finite at {tuple(map(int, np.argwhere(~np.isfinite(array))[0]))}"
    for name, axis in OFFSETS.items():
        at = arrays[name]
        if at[0] != 0 or at[-1] != sizes[axis] or (np.diff(at) < 0).any():
            yield name, f"does not rise from 0 to {sizes[axis]}"
            return
    yield from _wrong_visits(arrays)


def _wrong_visits(arrays: Arrays) -> Iterator[tuple[str, str]]:
    """Visits by drones or at samples that are not there, or where the drone is elsewhere."""
    scene = np.repeat(np.arange(len(arrays["seed"])), np.diff(arrays["task_offsets"]))  # (M,)
    drone, served = arrays["teacher_drone"], arrays["teacher_drone"] >= 0
    num_drones, num_samples = np.diff(arrays["drone_offsets"]), arrays["teacher_samples"].shape[1]
    if (drone >= num_drones[scene]).any() or (drone < -1).any():
        yield "teacher_drone", "names a drone that is not there"
        return
    place = arrays["teacher_place"]
    if ((place < 0) == served).any() or (place >= num_samples).any() or ((arrays["teacher_rank"] < 0) == served).any():
        yield "teacher_place", "or teacher_rank is missing, or a sample that is not there"
        return
    row = arrays["drone_offsets"][scene] + drone
    away = np.linalg.norm(arrays["teacher_samples"][row[served], place[served]] - arrays["tasks"][served], axis=1)
    if (away > ANCHOR_TOLERANCE_M).any():
        yield "teacher_samples", f"is {float(away.max()):g} m from a task it serves"
