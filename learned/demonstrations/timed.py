"""Timed demonstrations: flights as decoded and as CasADi smoothed them, of fleets whose smoothed plan is certified.

    python -m learned.demonstrations.timed --scenes 3000 --seed 0 --out runs/timed

Killed and started again, it goes on where it stopped; asked for more scenes, it adds them. The same settings give the same
bytes, whatever the number of jobs. `learned.demonstrations.timed_shards.load_stages` reads them; docs/timed-flights.md says
what is in them. Exit status 0, or 2 on bad input.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from flockopt import SettingsError, compute_travel, decode, refine_bundles
from flockopt.cli.status import run_command
from flockopt.flights import Flight
from flockopt.flights.smoothing.smooth import Smoothed, smooth_each
from flockopt.flights.smoothing.stages import split
from flockopt.planning.finish import GivenFlights, finish
from flockopt.records import checks
from flockopt.records.status import Status
from flockopt.scene import Scene
from learned.demonstrations.array_files import Arrays
from learned.demonstrations.command import add_options, mix_of, write_with_bar
from learned.demonstrations.scenes import SceneMix, draw_scene, random_bundles
from learned.demonstrations.shard_runs import ShardRun
from learned.demonstrations.timed_shards import StageRecord, TimedScene, pack_scenes, read_shard, write_shard

__all__ = ["TimedSettings", "main", "make_shard", "timed_shards"]

#: Scenes in a shard: what is lost when a run is killed.
SHARD_SCENES = 50

#: Which scenes, unless told otherwise: hard ones are fewer than for drawing in space, as good bundles' flights have joints
#: enough to be improved; and there is no extra room, as training asks for that itself.
MIX = SceneMix(hard_share=0.3, margin=0.0)


@dataclass(frozen=True)
class TimedSettings:
    """What is demonstrated.

    Attributes:
        mix: The scenes. Its margin is what flights and their smoothing keep beyond the scene's clearance.
        seed: Of the first scene; the others follow.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    mix: SceneMix = field(default_factory=lambda: MIX)
    seed: int = 0

    def __post_init__(self) -> None:
        checks.store(self, checks.integer, SettingsError, "seed", least=0)

    def terms(self) -> dict[str, Any]:
        """What shards of one folder share."""
        return {**asdict(self), "shard_scenes": SHARD_SCENES}


def make_shard(settings: TimedSettings, seeds: Sequence[int]) -> Arrays:
    """The arrays of the demonstrations for these scenes."""
    return pack_scenes([_demonstrated(settings.mix, seed) for seed in seeds])


def _demonstrated(mix: SceneMix, seed: int) -> TimedScene:
    """A scene with its stages before and after, if the smoothed fleet, kept apart, is certified."""
    scene, is_hard = draw_scene(mix, seed)
    room = scene.replace(clearance=scene.clearance + mix.margin)
    travel = compute_travel(room)
    bundles = random_bundles(room, seed) if is_hard else refine_bundles(room, travel=travel, seed=seed)
    given = {} if bundles.status == Status.INFEASIBLE else decode(room, bundles, travel=travel)
    reports = smooth_each(room, given)
    smoothed = GivenFlights({name: each.flight for name, each in reports.items()})
    certified = bool(given) and finish(room, travel, bundles, smoothed, planner="search").status == Status.CERTIFIED
    stages = tuple(_stages(room, given, reports)) if certified else ()
    return TimedScene(seed, is_hard, room, certified, sum(each.iterations for each in reports.values()), stages)


def _stages(scene: Scene, given: Mapping[str, Flight], reports: Mapping[str, Smoothed]) -> Iterator[StageRecord]:
    """Every stage that was made better."""
    drones = {drone.id: drone for drone in scene.drones}
    for name, flight in given.items():
        if reports[name].flight is flight:
            continue
        for before, after in zip(split(flight), split(reports[name].flight), strict=True):
            guess = before.without_slivers()
            if not before.rests and len(guess.durations) == len(after.durations):
                yield StageRecord.of(scene, drones[name], guess, after)


def timed_shards(folder: Path, settings: TimedSettings) -> ShardRun:
    """The shards of a folder; `ShardRun.go` makes those that it does not hold yet, if CasADi is installed."""
    make, content = partial(make_shard, settings), "timed demonstrations"
    return ShardRun(folder, settings.terms(), content, make, write_shard, _size, SHARD_SCENES, settings.seed)


def _size(path: Path) -> int:
    """How many scenes a shard holds."""
    return len(read_shard(path)["seed"])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    return run_command("learned.demonstrations.timed", lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learned.demonstrations.timed", description=(__doc__ or "").split("\n")[0])
    add_options(parser, MIX, scenes=3000)
    return parser


def _run(options: argparse.Namespace) -> None:
    write_with_bar(options, timed_shards(options.out, TimedSettings(mix_of(options), options.seed)))


if __name__ == "__main__":
    raise SystemExit(main())
