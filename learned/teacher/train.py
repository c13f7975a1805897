"""Train the teacher or MAGNNET by proximal policy optimisation.

    python -m learned.teacher.train --method teacher --seed 0 --out runs/teacher-0

Writes a checkpoint, ``history.jsonl``, TensorBoard logs and, at the end, ``teacher.safetensors``. Killed and started again
it goes on where it stopped. With ``--install`` the weights are copied to where the planners look for them. The same seed
gives the same weights on one machine. Exit status 0, or 2 on bad input.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from flockopt import SettingsError
from flockopt.batches.progress import ProgressBar
from flockopt.cli.status import run_command
from flockopt.errors import require
from flockopt.records import checks, files
from learned.networks.shipped import shipped_path
from learned.teacher.training.settings import METHODS, AllocatorTrainingSettings

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    return run_command("learned.teacher.train", lambda: _train(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learned.teacher.train", description=__doc__.split("\n")[0])
    parser.add_argument("--method", default="teacher", help=f"what to train: {' or '.join(METHODS)} (default teacher)")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default 0)")
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoint, logs and weights")
    parser.add_argument(
        "--pool", type=Path, default=Path("runs/teacher/pool"),
        help="folder of training scenes, made there where missing (default runs/teacher/pool)",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, help="processes that make missing training scenes (default 1)")
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    parser.add_argument("--install", action="store_true", help="copy the weights to learned/weights at the end")
    settings = parser.add_argument_group("settings of the training")
    for field in dataclasses.fields(AllocatorTrainingSettings):
        if field.name not in ("method", "seed"):
            flag = "--" + field.name.replace("_", "-")
            settings.add_argument(flag, type=type(field.default), metavar="X", help=f"default {field.default:g}")
    return parser


def _train(options: argparse.Namespace) -> None:
    names = [field.name for field in dataclasses.fields(AllocatorTrainingSettings)]
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    settings = AllocatorTrainingSettings.from_dict(given)
    threads = checks.integer(SettingsError, "threads", options.threads, least=1)
    checks.integer(SettingsError, "jobs", options.jobs, least=1)
    require("torch", extra="learned")
    require("tensorboard", extra="learned")
    import torch
    from torch.utils.tensorboard import SummaryWriter

    from learned.teacher.training.run import Training, final_weights
    from learned.teacher.training.scene_pool import ScenePool, build_pool
    from learned.teacher.training.validation import ValidationSet

    _make_folder(options.out)
    torch.set_num_threads(threads)
    build_pool(options.pool, jobs=options.jobs)
    training = Training(settings, ScenePool.load(options.pool), options.out, ValidationSet.make(settings.slots))
    with SummaryWriter(str(options.out / "tensorboard"), purge_step=training.iteration + 1) as writer:
        bar = ProgressBar(settings.iterations, training.iteration)

        def report(row: dict[str, float]) -> None:
            for name, value in row.items():
                writer.add_scalar(name, value, int(row["iteration"]))
            bar.advance(_words(row))

        training.run(report)
        bar.close()
    if options.install:
        _install(final_weights(options.out, settings.method))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        value = f"{folder} cannot be used ({fault.strerror})"
        raise SettingsError("out", value, "must be a folder to write to", "choose another") from None


def _install(path: Path) -> None:
    files.write_whole(SettingsError, shipped_path(path.stem), path.read_bytes())


def _words(row: dict[str, float]) -> str:
    """The figures of an iteration in a line."""
    measured = f", {row['excess']:.2%} above the reference in {row['greedy_steps']:.2f} steps" if "excess" in row else ""
    return f"return {row['episode_return']:.3f}{measured}"


if __name__ == "__main__":
    sys.exit(main())
