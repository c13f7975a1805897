"""What the command lines of demonstrations share: which scenes, how many, by whom, and how far they are."""

from __future__ import annotations

import argparse
from pathlib import Path

from flockopt import SettingsError
from flockopt.batches.backends import BACKENDS
from flockopt.batches.progress import ProgressBar
from flockopt.records import checks
from flockopt.scene.families.layouts import FAMILIES
from learned.demonstrations.scenes import SceneMix
from learned.demonstrations.shard_runs import ShardRun

__all__ = ["add_options", "mix_of", "write_with_bar"]


def add_options(parser: argparse.ArgumentParser, mix: SceneMix, scenes: int) -> None:
    """Options that say which scenes are demonstrated and who makes the shards; defaults are the mix's."""
    parser.add_argument("--scenes", type=int, default=scenes, help=f"how many (default {scenes})")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene; the others follow (default 0)")
    parser.add_argument("--family", default=mix.family, help=f"{', '.join(FAMILIES)} or all (default {mix.family})")
    for name, share, words in (
        ("--hard", mix.hard_share, "of hard scenes"), ("--usual", mix.usual_share, "of scenes with 10 drones, 20 tasks"),
    ):  # fmt: skip
        parser.add_argument(name, type=float, default=share, metavar="SHARE", help=f"{words} (default {share:g})")
    parser.add_argument(
        "--margin", type=float, default=mix.margin, metavar="M",
        help=f"how much farther from obstacles than they must drones keep, metres (default {mix.margin:g})",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, help="shards side by side (default 1)")
    parser.add_argument(
        "--backend", default="loky", help=f"where they are made: {', '.join(BACKENDS)} (default loky: processes)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the shards")


def mix_of(options: argparse.Namespace) -> SceneMix:
    """The scenes that were asked for.

    Raises:
        SettingsError: Naming the option, the value, the rule and the mend.
    """
    return SceneMix(options.family, options.hard, options.usual, options.margin)


def write_with_bar(options: argparse.Namespace, run: ShardRun) -> None:
    """Have the shards written that were asked for, with a progress bar.

    Raises:
        SettingsError: On bad counts, an unknown backend, or what `ShardRun.go` finds.
    """
    scenes = checks.integer(SettingsError, "scenes", options.scenes, least=1)
    jobs = checks.integer(SettingsError, "jobs", options.jobs, least=1)
    checks.choice(SettingsError, "backend", options.backend, known=BACKENDS)
    bars: list[ProgressBar] = []
    run.go(
        scenes, jobs=jobs, backend=options.backend,
        begun=lambda total, done: bars.append(ProgressBar(total, done)),
        done=lambda words: bars[0].advance(words), warn=lambda words: bars[0].note(words),
    )  # fmt: skip
    for bar in bars:
        bar.close()
