"""Train a student from demonstrations.

    python -m learned.student.train --config small --data runs/demonstrations --out runs/student-small

Killed and started again, it goes on from its last checkpoint and ends with the same weights. Over several processes:

    torchrun --nproc-per-node 2 -m learned.student.train --config small --data DIR --out DIR

Writes ``checkpoint.safetensors``, ``student.safetensors`` (averaged weights, for `learned.student.planner`) and logs for
TensorBoard. Exit status 0, or 2 on bad input.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from contextlib import nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn
from torch.nn.attention import SDPBackend

from flockopt.batches.run_folder import RunFolder
from flockopt.cli.status import run_command
from learned.networks.training import Learner, Run, add_run_options, held_out, settings_of
from learned.student.checkpoint import STORAGES, load_student, save_student
from learned.student.inference import draw
from learned.student.loss import StudentLoss
from learned.student.network.model import Student
from learned.student.scenes.batch import FleetBatch, collate
from learned.student.scenes.demonstrated import example_of
from learned.student.scenes.examples import Example
from learned.student.settings import CONFIGS
from learned.student.training_settings import StudentTrainingSettings

__all__ = ["Trainer", "main"]

#: Scenes that are held out at the most, to measure on.
MOST_HELD_OUT = 64

#: Where whole fleets attend to each other, the fused kernels are the faster ones.
LONG_SEQUENCES = [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]

#: Counts in batches are rounded up to multiples of this.
COUNT_STEP = 4


class Trainer(Learner[Student]):
    """The state of a student's training, and one step of it.

    Args:
        settings: Of the run.
        examples: To learn from.
        rank: Of this process.
        world: How many processes there are.
    """

    def __init__(self, settings: StudentTrainingSettings, examples: Sequence[Example], rank: int = 0, world: int = 1) -> None:
        self.settings, self.examples, self.rank, self.world = settings, examples, rank, world
        torch.manual_seed(settings.seed)
        student = Student(CONFIGS[settings.config])
        student.spread.copy_(_spread(student, examples))
        super().__init__(student, settings, _device(rank))
        if student.settings.fleet_attention:
            self.attention = LONG_SEQUENCES
        loss = StudentLoss(student)
        # without fleet attention nothing reads the obstacle tokens
        self.loss: nn.Module = nn.parallel.DistributedDataParallel(loss, find_unused_parameters=True) if world > 1 else loss

    def _losses(self) -> tuple[Tensor, dict[str, Tensor]]:
        generator = torch.Generator().manual_seed((self.settings.seed * 1_000_003 + self.step) * 1009 + self.rank)
        batch = self._batch().mirrored(generator).to(self.device)
        return self.loss(batch, self.settings.loss_weights(self.step), generator)

    def _batch(self) -> FleetBatch:
        """This process's part of the step's scenes: every epoch is a new order of all examples."""
        each, count = self.settings.scenes_per_step, len(self.examples)
        epochs, indices = np.divmod(np.arange(self.step * each, (self.step + 1) * each), count)
        order = cache(lambda epoch: np.random.default_rng([self.settings.seed, epoch]).permutation(count))
        chosen = [int(order(epoch)[index]) for epoch, index in zip(epochs.tolist(), indices.tolist(), strict=True)]
        return collate([self.examples[index] for index in chosen[self.rank :: self.world]], COUNT_STEP)


def _device(rank: int) -> torch.device:
    """Each process has a GPU where there are some."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", rank % torch.cuda.device_count())


def measure(student: Student, examples: Sequence[Example]) -> dict[str, float]:
    """Shares of scenes and of blocked drones clear before mending, one try; share of tasks given to the teacher's drone."""
    drawings = draw(student, examples, tries=1)
    blocked = np.concatenate([one.is_blocked for one in examples])
    clear = np.concatenate([drawing.clear for drawing in drawings])
    batch = collate(examples)
    with torch.inference_mode():
        guessed = student.allocate(batch).argmax(dim=-1)
    counted = (batch.assignment >= 0) & batch.teaches_allocation[:, None]
    return {
        "scenes_clear": float(np.mean([drawing.clear.all() for drawing in drawings])),
        "blocked_drones_clear": float(clear[blocked].mean()) if blocked.any() else 1.0,
        "allocation_accuracy": float((guessed == batch.assignment)[counted].float().mean()) if bool(counted.any()) else 0.0,
    }


@torch.no_grad()
def _spread(student: Student, examples: Sequence[Example]) -> Tensor:
    """(3,): root mean squares of the clean samples that are learned, over some of the examples."""
    batch = collate(examples[:256])
    chosen = batch.ways.active
    if not student.settings.fleet_attention:
        chosen = chosen & batch.ways.blocked.any(dim=-1)
    clean = student.clean_samples(batch.ways)[chosen]  # (R, T, 3)
    if not len(clean):
        return torch.ones(3)
    return clean.square().mean(dim=(0, 1)).sqrt().clamp(min=1e-3)


def run(
    settings: StudentTrainingSettings,
    data: Sequence[Path],
    out: Path,
    rank: int,
    world: int,
    begin_with: Path | None,
    until: int | None,
    storage: str = STORAGES[0],
) -> None:
    """Train to the end, or ``until`` a step, going on from a checkpoint if there is one.

    A run that begins with a student's weights fine-tunes them. Of several processes the first one writes.
    """
    from learned.demonstrations.shards import load_demonstrations

    demonstrations = [demonstration for folder in data for demonstration in load_demonstrations(folder)]
    num_samples = CONFIGS[settings.config].num_samples
    examples = [example_of(demonstration, num_samples) for demonstration in demonstrations]
    taught, kept = held_out(examples, settings.seed, MOST_HELD_OUT)
    trainer = Trainer(settings, taught, rank, world)
    begun = trainer.begin_with(begin_with, load_student)
    terms = {"settings": settings.to_dict(), "examples": len(examples), "begin_with": begun}

    def save(student: Student, notes: dict[str, Any]) -> None:
        save_student(out / "student.safetensors", student.state_dict(), student.settings, notes, storage)

    whole = Run(trainer, out, terms, partial(measure, examples=kept), save)
    whole.until(settings.steps if until is None else min(until, settings.steps), is_silent=rank > 0)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    try:
        return run_command("learned.student.train", lambda: _train(options))
    finally:
        if distributed.is_initialized():
            distributed.destroy_process_group()


def _train(options: argparse.Namespace) -> None:
    """Train as one of the processes that torchrun starts, or alone; the first of them owns the folder."""
    rank, world = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    settings = settings_of(options, StudentTrainingSettings)
    if world > 1:
        distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    with RunFolder(options.out, settings.to_dict(), "a student's training") if rank == 0 else nullcontext():
        run(settings, options.data, options.out, rank, world, options.begin_with, options.until, options.store_as)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learned.student.train", description=(__doc__ or "").split("\n")[0])
    defaults = StudentTrainingSettings()
    parser.add_argument("--config", choices=CONFIGS, help=f"(default {defaults.config})")
    parser.add_argument("--store-as", choices=STORAGES, default=STORAGES[0], help=f"of the weights (default {STORAGES[0]})")
    whole = ("steps", "scenes_per_step", "warmup_steps", "seed")
    shares = ("learning_rate", "ema_decay", "clearance_weight", "clearance_from", "allocation_weight")
    add_run_options(parser, defaults, whole, shares)
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
