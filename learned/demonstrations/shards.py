"""Demonstrations in files: ``shard-00000.npz`` and so on, read strictly, without pickle (docs/demonstrations.md)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flockopt.bundles import Bundles
from flockopt.errors import SettingsError
from flockopt.scene import Scene
from learned.demonstrations.array_files import Arrays, layout_faults, read_arrays, shard_path, write_arrays
from learned.demonstrations.flat_arrays import LAYOUT, OFFSETS, Demonstration, Demonstrations
from learned.paths.rollout import Rollout

__all__ = ["Demonstration", "Demonstrations", "load_demonstrations", "pack", "shard_path", "write_shard"]

FORMAT = "flockopt.demonstrations/1"

#: An array to tell the length of each axis by.
LEADERS = {"S": "seed", "N": "starts", "M": "tasks", "K": "obstacles", "V": "teacher_stops"}

#: How far a sample may be from the task it stands for, metres: what single precision loses.
ANCHOR_TOLERANCE_M = 1e-3


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


def write_shard(path: Path, arrays: Arrays) -> None:
    """Write a shard, whole or not at all; equal arrays give equal bytes."""
    write_arrays(path, arrays, FORMAT)


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
    arrays = read_arrays(path, LAYOUT, FORMAT, mend)
    for name, complaint in _faults(arrays):
        raise SettingsError(f"data: {path}: {name}", complaint, rule, mend)
    return arrays


def _faults(arrays: Arrays) -> Iterator[tuple[str, str]]:
    """What is wrong with arrays of the right names: shapes, kinds, then what they mean."""
    sizes: dict[int | str, int] = {axis: len(arrays[name]) for axis, name in LEADERS.items()}
    samples = arrays["teacher_samples"]
    sizes |= {"S+1": sizes["S"] + 1, "N+1": sizes["N"] + 1, "T": samples.shape[1] if samples.ndim == 3 else -1}
    faults = list(layout_faults(arrays, LAYOUT, sizes, OFFSETS))
    yield from faults
    if not faults:
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
