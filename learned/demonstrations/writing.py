"""Demonstrations made and written: what is demonstrated, by which teacher, and the shards of a folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from flockopt import SettingsError, refine_bundles
from flockopt.bundles import Bundles
from flockopt.records import checks
from flockopt.scene import Scene
from flockopt.travel import Travel
from learned.demonstrations.scenes import SceneMix, draw_scene, random_bundles
from learned.demonstrations.shard_runs import ShardRun
from learned.demonstrations.shards import pack, read_shard, write_shard
from learned.paths.rollout import NUM_SAMPLES, roll_out
from learned.paths.ways import ANY_ANGLE, PATHS, Ways, find_ways
from learned.teacher.planner import allocator, bundles_of, refined

__all__ = ["TEACHERS", "DemonstrationSettings", "demonstration_shards", "make_shard"]

#: Scenes in a shard: what is lost when a run is killed.
SHARD_SCENES = 100

#: Bundles for scenes, given their travel and seeds.
Teacher: TypeAlias = Callable[[Sequence[Scene], Sequence[Travel], Sequence[int]], list[Bundles]]


def _search(scenes: Sequence[Scene], travels: Sequence[Travel], seeds: Sequence[int]) -> list[Bundles]:
    """Near-optimal bundles."""
    cases = zip(scenes, travels, seeds, strict=True)
    return [refine_bundles(scene, travel=travel, seed=seed) for scene, travel, seed in cases]


def _policy(refines: bool, scenes: Sequence[Scene], travels: Sequence[Travel], seeds: Sequence[int]) -> list[Bundles]:
    """The trained policy's bundles, refined or not."""
    routes = [allocation.routes for allocation in allocator("teacher").bundles(scenes, travels)]
    routes = refined(scenes, travels, routes) if refines else routes
    return [bundles_of(scene, travel, own, "teacher") for scene, travel, own in zip(scenes, travels, routes, strict=True)]


#: Who makes the bundles of scenes that are not hard.
TEACHERS: dict[str, Teacher] = {
    "search": _search, "teacher": partial(_policy, False), "teacher+refine": partial(_policy, True),
}  # fmt: skip


@dataclass(frozen=True)
class DemonstrationSettings:
    """What is demonstrated, and how.

    Attributes:
        mix: The scenes.
        seed: Of the first scene; the others follow.
        teacher: One of `TEACHERS`.
        paths: One of `learned.paths.ways.PATHS`.
        num_samples: T.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    mix: SceneMix = field(default_factory=SceneMix)
    seed: int = 0
    teacher: str = "search"
    paths: str = ANY_ANGLE
    num_samples: int = NUM_SAMPLES

    def __post_init__(self) -> None:
        checks.store(self, checks.integer, SettingsError, "seed", least=0)
        checks.store(self, checks.integer, SettingsError, "num_samples", least=2)
        checks.store(self, checks.choice, SettingsError, "teacher", known=TEACHERS)
        checks.store(self, checks.choice, SettingsError, "paths", known=PATHS)

    def terms(self) -> dict[str, Any]:
        """What shards of one folder share."""
        return {**asdict(self), "shard_scenes": SHARD_SCENES}


def make_shard(settings: DemonstrationSettings, seeds: Sequence[int]) -> dict[str, Any]:
    """The arrays of the demonstrations for these scenes."""
    scenes, are_hard = zip(*(draw_scene(settings.mix, seed) for seed in seeds), strict=True)
    roomier = [scene.replace(clearance=scene.clearance + settings.mix.margin) for scene in scenes]
    taught = [index for index, is_hard in enumerate(are_hard) if not is_hard]
    ways = {index: find_ways(roomier[index], settings.paths) for index in taught}
    bundles = dict(zip(taught, _taught(settings.teacher, scenes, ways, seeds), strict=True))
    rows = []
    for index, (scene, is_hard, seed) in enumerate(zip(scenes, are_hard, seeds, strict=True)):
        chosen = random_bundles(roomier[index], seed) if is_hard else bundles[index]
        way = find_ways(roomier[index], settings.paths, routes=chosen.routes) if is_hard else ways[index]
        rollout = roll_out(scene, chosen, way.leg, settings.num_samples)
        rows.append((seed, scene.name.split("-")[0], is_hard, scene, chosen, rollout))
    return pack(rows)


def _taught(teacher: str, scenes: Sequence[Scene], ways: Mapping[int, Ways], seeds: Sequence[int]) -> list[Bundles]:
    """What a teacher makes of those of the scenes that it has ways for."""
    if not ways:
        return []
    return TEACHERS[teacher]([scenes[index] for index in ways], [way.travel for way in ways.values()], [seeds[i] for i in ways])


def demonstration_shards(folder: Path, settings: DemonstrationSettings) -> ShardRun:
    """The shards of a folder; `ShardRun.go` makes those that it does not hold yet."""
    return ShardRun(
        folder,
        settings.terms(),
        "demonstrations",
        partial(make_shard, settings),
        write_shard,
        _size,
        SHARD_SCENES,
        settings.seed,
    )


def _size(path: Path) -> int:
    """How many scenes a shard holds."""
    return len(read_shard(path)["seed"])
