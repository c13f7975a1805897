"""Timed demonstrations in files and in memory: stages of flights as decoded, and as the solver smoothed them.

What belongs to obstacles, stages and joints stands in one row for all scenes, and ``*_offsets`` say where each part begins.
A joint comes with the piece that follows it; a stage's last joint has none. docs/timed-flights.md lists every array.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SettingsError
from flockopt.flights.smoothing.acceptance import JOINT_PHASE, limits_of
from flockopt.flights.smoothing.stages import Stage
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene
from learned.demonstrations.array_files import ArrayLayout, Arrays, layout_faults, read_arrays, write_arrays

__all__ = ["NO_PHASE", "StageRecord", "TimedScene", "anchors_at", "load_stages", "pack_scenes", "read_shard", "write_shard"]

FORMAT = "flockopt.timed-demonstrations/1"

#: The phase of a piece that passes no task inside.
NO_PHASE = -1.0

#: S scenes, K obstacles of all of them; R stages, and J joints of all of them.
LAYOUT: ArrayLayout = {
    "seed": (np.int64, ("S",)), "family": (np.str_, ("S",)), "hard": (np.bool_, ("S",)), "certified": (np.bool_, ("S",)),
    "bounds": (np.float64, ("S", 2, 3)), "clearance": (np.float64, ("S",)), "teacher_iterations": (np.int64, ("S",)),
    "obstacle_offsets": (np.int64, ("S+1",)), "obstacles": (np.float64, ("K", 9)),
    "stage_scene": (np.int64, ("R",)), "radii": (np.float64, ("R",)), "limits": (np.float64, ("R", 3)),
    "joint_offsets": (np.int64, ("R+1",)),
    "states": (np.float32, ("J", 3, 3)), "durations": (np.float32, ("J",)), "phases": (np.float32, ("J",)),
    "anchored": (np.bool_, ("J",)), "teacher_states": (np.float32, ("J", 3, 3)), "teacher_durations": (np.float32, ("J",)),
}  # fmt: skip
OFFSETS = {"obstacle_offsets": "K", "joint_offsets": "J"}


@dataclass(frozen=True, eq=False)
class StageRecord:
    """A stage to be improved among obstacles, and what the teacher made of it, if there is one.

    Attributes:
        obstacles: (K, 9), see `flockopt.geometry.distances.OBSTACLE_COLUMNS`.
        bounds: (2, 3) m.
        need: What its centre keeps from obstacles, metres.
        limits: (3,) m/s, m/s², m/s³.
        states: (J, 3, 3) position, velocity and acceleration at the joints.
        durations: (J - 1,) s.
        phases: (J - 1,) where in each piece a task is passed, `NO_PHASE` for nowhere.
        anchored: (J,) bool, joints at tasks.
        teacher_states: (J, 3, 3), or None.
        teacher_durations: (J - 1,) s, or None.
    """

    obstacles: FloatArray
    bounds: FloatArray
    need: float
    limits: FloatArray
    states: FloatArray
    durations: FloatArray
    phases: FloatArray
    anchored: NDArray[np.bool_]
    teacher_states: FloatArray | None = None
    teacher_durations: FloatArray | None = None

    @classmethod
    def of(cls, scene: Scene, drone: Drone, stage: Stage, teacher: Stage | None = None) -> StageRecord:
        """The record of a stage without slivers in a scene."""
        phases, anchored = anchors_at(stage)
        return cls(
            scene.obstacle_table, np.array([scene.bounds.lower, scene.bounds.upper]), drone.radius + scene.clearance,
            np.array(limits_of(drone)), stage.states, stage.durations, phases, anchored,
            None if teacher is None else teacher.states, None if teacher is None else teacher.durations,
        )  # fmt: skip


def anchors_at(stage: Stage) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where in each piece (K,) a task is passed, and which joints (K + 1,) are at tasks."""
    phases, anchored = np.full(len(stage.durations), NO_PHASE), np.zeros(len(stage.durations) + 1, dtype=np.bool_)
    for piece, phase, _ in stage.visits:
        if min(phase, 1.0 - phase) <= JOINT_PHASE:
            anchored[piece + round(phase)] = True
        else:
            phases[piece] = phase
    return phases, anchored


@dataclass(frozen=True, eq=False)
class TimedScene:
    """A scene that was demonstrated: its stages, each with the teacher's, none where the plan was not certified."""

    seed: int
    hard: bool
    scene: Scene
    certified: bool
    iterations: int
    stages: tuple[StageRecord, ...]


def pack_scenes(scenes: Sequence[TimedScene]) -> Arrays:
    """The arrays of a shard."""
    stages = [(index, stage) for index, each in enumerate(scenes) for stage in each.stages]
    columns: dict[str, Any] = {
        "seed": [each.seed for each in scenes], "family": [each.scene.name.split("-")[0] for each in scenes],
        "hard": [each.hard for each in scenes], "certified": [each.certified for each in scenes],
        "bounds": [(each.scene.bounds.lower, each.scene.bounds.upper) for each in scenes],
        "clearance": [each.scene.clearance for each in scenes], "teacher_iterations": [each.iterations for each in scenes],
        "obstacle_offsets": np.cumsum([0, *(len(each.scene.obstacles) for each in scenes)]),
        "obstacles": np.concatenate([np.empty((0, 9)), *(each.scene.obstacle_table for each in scenes)]),
        "stage_scene": [index for index, _ in stages],
        "radii": [stage.need - scenes[index].scene.clearance for index, stage in stages],
        "limits": np.concatenate([np.empty((0, 3)), *(stage.limits[None] for _, stage in stages)]),
        "joint_offsets": np.cumsum([0, *(len(stage.states) for _, stage in stages)]),
    }  # fmt: skip
    for name in ("states", "durations", "phases", "anchored", "teacher_states", "teacher_durations"):
        empty = np.empty((0, 3, 3)) if name.endswith("states") else np.empty(0)
        fill = NO_PHASE if name == "phases" else 0.0
        parts = [_to_joints(getattr(stage, name), len(stage.states), fill) for _, stage in stages]
        columns[name] = np.concatenate([empty, *parts])
    return {name: np.asarray(columns[name], dtype=kind) for name, (kind, _) in LAYOUT.items()}


def _to_joints(values: NDArray[Any], num_joints: int, fill: float) -> NDArray[Any]:
    """Values of pieces, with one for the last joint."""
    return values if len(values) == num_joints else np.append(values, fill)


def write_shard(path: Path, arrays: Arrays) -> None:
    """Write a shard, whole or not at all; equal arrays give equal bytes."""
    write_arrays(path, arrays, FORMAT)


def read_shard(path: Path) -> Arrays:
    """The arrays of one shard.

    Raises:
        SettingsError: Naming the file, and the array where it is one.
    """
    mend = "delete it and run learned.demonstrations.timed again"
    arrays = read_arrays(path, LAYOUT, FORMAT, mend)
    for name, complaint in _faults(arrays):
        raise SettingsError(f"data: {path}: {name}", complaint, f"must be a shard of format {FORMAT}", mend)
    return arrays


def _faults(arrays: Arrays) -> Iterator[tuple[str, str]]:
    """What is wrong with arrays of the right names: shapes, kinds, then what they mean."""
    sizes: dict[int | str, int] = {
        axis: len(np.atleast_1d(arrays[name]))
        for axis, name in (("S", "seed"), ("K", "obstacles"), ("R", "stage_scene"), ("J", "durations"))
    }
    sizes |= {"S+1": sizes["S"] + 1, "R+1": sizes["R"] + 1}
    faults = list(layout_faults(arrays, LAYOUT, sizes, OFFSETS))
    yield from faults
    if not faults:
        yield from _wrong_stages(arrays, sizes)


def _wrong_stages(arrays: Arrays, sizes: dict[int | str, int]) -> Iterator[tuple[str, str]]:
    """Stages of scenes that are not there or not certified, of one joint, or that take no time."""
    scene = arrays["stage_scene"]
    if (scene < 0).any() or (scene >= sizes["S"]).any() or not arrays["certified"][scene].all():
        yield "stage_scene", "names a scene that is not there or not certified"
    if (np.diff(arrays["joint_offsets"]) < 2).any():
        yield "joint_offsets", "leaves a stage fewer than 2 joints"
        return
    followed = np.ones(sizes["J"], dtype=np.bool_)
    followed[arrays["joint_offsets"][1:] - 1] = False
    for name in ("durations", "teacher_durations"):
        if (arrays[name][followed] <= 0.0).any():
            yield name, "is not above 0 on every piece"


def load_stages(folder: str | Path) -> list[StageRecord]:
    """All demonstrated stages in a folder, those of a run that was stopped too.

    Raises:
        SettingsError: If there are none, or a shard is damaged or not ours; the message names it.
    """
    paths = sorted(Path(folder).glob("shard-*.npz"))
    stages = [stage for path in paths for stage in _stages(read_shard(path))]
    if not stages:
        rule, mend = "must be a folder with shards that hold stages", "make some with python -m learned.demonstrations.timed"
        raise SettingsError("data", f"{folder} has none", rule, mend)
    return stages


def _stages(arrays: Arrays) -> Iterator[StageRecord]:
    """The stages of a shard."""
    for row, scene in enumerate(arrays["stage_scene"]):
        joints = slice(*arrays["joint_offsets"][row : row + 2])
        pieces = slice(joints.start, joints.stop - 1)
        yield StageRecord(
            arrays["obstacles"][slice(*arrays["obstacle_offsets"][scene : scene + 2])], arrays["bounds"][scene],
            float(arrays["radii"][row] + arrays["clearance"][scene]), arrays["limits"][row], arrays["states"][joints],
            arrays["durations"][pieces], arrays["phases"][pieces], arrays["anchored"][joints],
            arrays["teacher_states"][joints], arrays["teacher_durations"][pieces],
        )  # fmt: skip
