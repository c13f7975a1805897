"""Training scenes: large scenes of the five families with their travel, of which every problem takes a part.

A pool scene has `POOL_DRONES` starts and `POOL_TASKS` tasks in the same space as a scene of 10 x 20 has. Any choice of
some starts and tasks with the legs between them is a scene of the family again, so a few hundred scenes give problems
without end and of every size up to theirs, while travel is computed once.

Seeds: the pool holds seeds `FIRST_POOL_SEED` and above, curves in training are measured on seeds `FIRST_VALIDATION_SEED` and
above, and every seed below that is held out, which is where benchmarks begin to count.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flockopt.errors import SettingsError
from flockopt.records import files
from flockopt.scene.families.generate import generate
from flockopt.scene.families.layouts import FAMILIES
from flockopt.travel.compute import compute_travel
from learned.teacher.problems import Problems, open_problems, random_capacities

__all__ = ["FIRST_POOL_SEED", "FIRST_VALIDATION_SEED", "POOL_DRONES", "POOL_TASKS", "ScenePool", "build_pool"]

POOL_DRONES, POOL_TASKS = 30, 60

FIRST_VALIDATION_SEED, FIRST_POOL_SEED = 900_000, 1_000_000

#: Scenes in a file of the pool, and such files for each family.
SHARD_SCENES, NUM_SHARDS = 16, 12

#: What a file holds: shapes of one scene.
SHAPES = {
    "starts": (POOL_DRONES, 3), "tasks": (POOL_TASKS, 3),
    "start_task": (POOL_DRONES, POOL_TASKS), "task_task": (POOL_TASKS, POOL_TASKS),
}  # fmt: skip

MEND = "remove it; it is made again"


def build_pool(folder: Path, *, jobs: int = 1, num_shards: int = NUM_SHARDS) -> None:
    """Make what is missing of the pool; files that are there are kept.

    Args:
        folder: Where; made if it does not exist.
        jobs: How many processes.
        num_shards: Files for each family.

    Raises:
        SettingsError: If the folder cannot be written to.
    """
    from joblib import Parallel, delayed

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        value = f"{folder} cannot be used ({fault.strerror})"
        raise SettingsError("pool", value, "must be a folder to write to", "choose another") from None
    wanted = [(family, shard, folder / f"{family}-{shard:03d}.npz") for shard in range(num_shards) for family in FAMILIES]
    Parallel(n_jobs=jobs)(delayed(_build_shard)(*item) for item in wanted if not item[2].exists())


def _build_shard(family: str, shard: int, path: Path) -> None:
    rows: dict[str, list[np.ndarray]] = {name: [] for name in SHAPES}
    for seed in range(FIRST_POOL_SEED + shard * SHARD_SCENES, FIRST_POOL_SEED + (shard + 1) * SHARD_SCENES):
        scene = generate(family, drones=POOL_DRONES, tasks=POOL_TASKS, seed=seed)
        travel = compute_travel(scene)
        found = (scene.starts, scene.task_positions, travel.start_task, travel.task_task[0])
        for name, values in zip(SHAPES, found, strict=True):
            rows[name].append(values.astype(np.float32))
    content = io.BytesIO()
    arrays: dict[str, Any] = {name: np.stack(values) for name, values in rows.items()}
    np.savez(content, **arrays)
    files.write_whole(SettingsError, path, content.getvalue())


@dataclass(frozen=True, eq=False)
class ScenePool:
    """The pool in memory: S scenes.

    Attributes:
        starts: (S, `POOL_DRONES`, 3) m.
        tasks: (S, `POOL_TASKS`, 3) m.
        start_task: (S, `POOL_DRONES`, `POOL_TASKS`) m.
        task_task: (S, `POOL_TASKS`, `POOL_TASKS`) m.
    """

    starts: Tensor
    tasks: Tensor
    start_task: Tensor
    task_task: Tensor

    @staticmethod
    def load(folder: Path) -> ScenePool:
        """All files of a folder.

        Raises:
            SettingsError: If there is none, or one is damaged.
        """
        paths = sorted(folder.glob("*.npz"))
        if not paths:
            raise SettingsError("pool", f"{folder} holds no scenes", "must be a folder that build_pool filled", "build it")
        shards = [_read_shard(path) for path in paths]
        return ScenePool(**{name: torch.from_numpy(np.concatenate([shard[name] for shard in shards])) for name in SHAPES})

    def draw(self, count: int, drones: int, tasks: int, generator: torch.Generator) -> Problems:
        """Problems at random: from random scenes, random starts, tasks and capacities.

        Args:
            count: B.
            drones: N, at most `POOL_DRONES`.
            tasks: M, at most `POOL_TASKS`.
            generator: Of everything random.
        """
        scene = torch.randint(len(self.starts), (count, 1), generator=generator)
        start = torch.rand(count, POOL_DRONES, generator=generator).argsort(dim=1)[:, :drones]
        task = torch.rand(count, POOL_TASKS, generator=generator).argsort(dim=1)[:, :tasks]
        return open_problems(
            self.starts[scene, start],
            self.tasks[scene, task],
            random_capacities(count, drones, tasks, generator),
            self.start_task[scene[..., None], start[:, :, None], task[:, None, :]],
            self.task_task[scene[..., None], task[:, :, None], task[:, None, :]],
        )


def _read_shard(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            shard = {name: file[name] for name in SHAPES}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as fault:
        raise SettingsError("pool", f"{path} is damaged ({fault})", "must be a file of build_pool", MEND) from None
    for name, shape in SHAPES.items():
        if shard[name].dtype != np.float32 or shard[name].shape[1:] != shape or len(shard[name]) != SHARD_SCENES:
            value = f"{path} holds {name!r} of {shard[name].dtype} {shard[name].shape}"
            raise SettingsError("pool", value, f"must be float32 {(SHARD_SCENES, *shape)}", MEND)
        if not np.isfinite(shard[name]).all():
            raise SettingsError("pool", f"{path} holds {name!r} that are not finite", "lengths are finite", MEND)
    return shard
