"""Demonstrations: scenes with a teacher's assignment A*, ordered bundles B* and fleet samples X* (N, T, 3), in shards.

    python -m learned.demonstrations --scenes 20000 --seed 0 --jobs 2 --teacher search --out runs/demonstrations

Killed and started again, it goes on where it stopped; asked for more scenes, it adds them. The same settings give the same
bytes, whatever the number of jobs. `learned.demonstrations.shards.load_demonstrations` reads them; docs/demonstrations.md
says what is in them. Exit status 0, or 2 on bad input.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from flockopt.cli.status import run_command
from learned.demonstrations.command import add_options, mix_of, write_with_bar
from learned.demonstrations.scenes import SceneMix
from learned.demonstrations.writing import TEACHERS, DemonstrationSettings, demonstration_shards
from learned.paths.rollout import NUM_SAMPLES
from learned.paths.ways import ANY_ANGLE, PATHS

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    return run_command("learned.demonstrations", lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learned.demonstrations", description=(__doc__ or "").split("\n")[0])
    add_options(parser, SceneMix(), scenes=20000)
    parser.add_argument("--teacher", default="search", help=f"who makes the bundles: {', '.join(TEACHERS)} (default search)")
    parser.add_argument("--paths", default=ANY_ANGLE, help=f"what legs are: {', '.join(PATHS)} (default {ANY_ANGLE})")
    parser.add_argument("--samples", type=int, default=NUM_SAMPLES, help=f"of each drone (default {NUM_SAMPLES})")
    return parser


def _run(options: argparse.Namespace) -> None:
    settings = DemonstrationSettings(mix_of(options), options.seed, options.teacher, options.paths, options.samples)
    write_with_bar(options, demonstration_shards(options.out, settings))


if __name__ == "__main__":
    raise SystemExit(main())
