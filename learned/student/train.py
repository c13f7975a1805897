"""Train a student from demonstrations.

    python -m learned.student.train --config small --data runs/demonstrations --out runs/student-small

Killed and started again, it goes on from its last checkpoint and ends with the same weights. Over several processes:

    torchrun --nproc-per-node 2 -m learned.student.train --config small --data DIR --out DIR

Writes ``checkpoint.safetensors``, ``student.safetensors`` (averaged weights, for `learned.student.planner`) and logs for
TensorBoard. Exit status 0, or 2 on bad input.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, distributed, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from flockopt import FlockError, SettingsError
from flockopt.progress_bar import ProgressBar
from flockopt.run_folder import RunFolder
from learned.student.batch import FleetBatch, collate
from learned.student.checkpoint import STORAGES, load_student, restore, save_checkpoint, save_student
from learned.student.dataset import example_of
from learned.student.examples import Example
from learned.student.inference import draw
from learned.student.loss import StudentLoss
from learned.student.model import Student
from learned.student.schedule import is_bfloat16, rate_at
from learned.student.settings import CONFIGS
from learned.student.training_settings import PRECISIONS, TrainingSettings

__all__ = ["Trainer", "main"]

#: Of the examples, this share, but not more than so many, is held out to measure on.
HELD_OUT_SHARE, MOST_HELD_OUT = 0.05, 64

#: Steps between measurements with a checkpoint, and between lines in the log.
CHECKPOINT_STEPS, LOG_STEPS = 250, 25

#: Counts in batches are rounded up to multiples of this.
COUNT_STEP = 4


class Trainer:
    """The state of a run, and one step of it.

    Args:
        settings: Of the run.
        examples: To learn from.
        rank: Of this process.
        world: How many processes there are.
    """

    def __init__(self, settings: TrainingSettings, examples: Sequence[Example], rank: int = 0, world: int = 1) -> None:
        self.settings, self.examples, self.rank, self.world = settings, examples, rank, world
        self.device = (
            torch.device("cuda", rank % torch.cuda.device_count()) if torch.cuda.is_available() else torch.device("cpu")
        )
        torch.manual_seed(settings.seed)
        self.student = Student(CONFIGS[settings.config])
        self.student.spread.copy_(_spread(self.student, examples))
        self.student.to(self.device)
        self.average = {name: value.detach().clone() for name, value in self.student.state_dict().items()}
        self.optimiser = torch.optim.AdamW(
            self.student.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, betas=(0.9, 0.99)
        )
        loss = StudentLoss(self.student)
        # without fleet attention nothing reads the obstacle tokens
        self.loss: nn.Module = nn.parallel.DistributedDataParallel(loss, find_unused_parameters=True) if world > 1 else loss
        self.step = 0

    def begin_with(self, path: Path | None) -> str | None:
        """Take the weights of a student's file, if one is given; the file's digest."""
        if path is None:
            return None
        student = load_student(path)
        if student.settings != self.student.settings:
            value = f"holds weights for other settings ({path})"
            raise SettingsError("begin_with", value, f"must be for {self.settings.config!r}", "choose the config they are for")
        for name, value in student.state_dict().items():
            self.student.state_dict()[name].copy_(value)
            self.average[name].copy_(value)
        return hashlib.sha256(path.read_bytes()).hexdigest()

    def advance(self) -> dict[str, float]:
        """One step of the optimiser; the loss's terms."""
        settings = self.settings
        generator = torch.Generator().manual_seed((settings.seed * 1_000_003 + self.step) * 1009 + self.rank)
        batch = self._batch().mirrored(generator).to(self.device)
        for group in self.optimiser.param_groups:
            group["lr"] = settings.learning_rate * rate_at(self.step, settings.steps, settings.warmup_steps)
        kind = torch.bfloat16 if is_bfloat16(settings.precision, self.device) else torch.float32
        with sdpa_kernel(self._attention):
            with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=kind is torch.bfloat16):
                total, terms = self.loss(batch, settings.loss_weights(self.step), generator)
            self.optimiser.zero_grad()
            total.backward()
        nn.utils.clip_grad_norm_(self.student.parameters(), settings.clip)
        self.optimiser.step()
        self.step += 1
        self._average()
        return {name: float(value) for name, value in {"total": total.detach(), **terms}.items()}

    @property
    def _attention(self) -> list[SDPBackend]:
        """What computes attention: fused kernels, but for a drone's few tokens, where their backward pass takes far longer."""
        if self.student.settings.fleet_attention:
            return [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]
        return [SDPBackend.MATH]

    def _batch(self) -> FleetBatch:
        """This process's part of the step's scenes: every epoch is a new order of all examples."""
        each, count = self.settings.scenes_per_step, len(self.examples)
        epochs, indices = np.divmod(np.arange(self.step * each, (self.step + 1) * each), count)
        order = cache(lambda epoch: np.random.default_rng([self.settings.seed, epoch]).permutation(count))
        chosen = [int(order(epoch)[index]) for epoch, index in zip(epochs.tolist(), indices.tolist(), strict=True)]
        return collate([self.examples[index] for index in chosen[self.rank :: self.world]], COUNT_STEP)

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.settings.ema_decay, (1 + self.step) / (10 + self.step))
        for name, value in self.student.state_dict().items():
            self.average[name].lerp_(value.to(self.average[name].dtype), 1.0 - decay)

    def averaged(self) -> Student:
        """A student with the averaged weights, on the CPU."""
        student = Student(self.student.settings)
        student.load_state_dict({name: value.cpu() for name, value in self.average.items()})
        return student.eval()


def measure(student: Student, examples: Sequence[Example]) -> dict[str, float]:
    """Shares of scenes and of blocked drones clear before mending, one try; share of tasks given to the teacher's drone."""
    drawings = draw(student, examples, tries=1)
    blocked = np.concatenate([one.blocked.any(axis=1) for one in examples])
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
    settings: TrainingSettings,
    data: Sequence[Path],
    out: Path,
    rank: int,
    world: int,
    begin_with: Path | None,
    until: int | None,
    storage: str = STORAGES[0],
) -> None:
    """Train to the end, or ``until`` a step, going on from a checkpoint if there is one.

    A run that begins with a student's weights fine-tunes them.
    """
    from torch.utils.tensorboard import SummaryWriter

    from learned.shards import load_demonstrations

    demonstrations = [demonstration for folder in data for demonstration in load_demonstrations(folder)]
    num_samples = CONFIGS[settings.config].num_samples
    examples = [example_of(demonstration, num_samples) for demonstration in demonstrations]
    num_held_out = min(MOST_HELD_OUT, math.ceil(HELD_OUT_SHARE * len(examples)))
    order = np.random.default_rng(settings.seed).permutation(len(examples))
    held_out = [examples[index] for index in order[:num_held_out]]
    trainer = Trainer(settings, [examples[index] for index in order[num_held_out:]] or held_out, rank, world)
    terms = {"settings": settings.to_dict(), "examples": len(examples), "begin_with": trainer.begin_with(begin_with)}
    last = settings.steps if until is None else min(until, settings.steps)
    checkpoint = out / "checkpoint.safetensors"
    if checkpoint.exists():
        trainer.step = restore(checkpoint, trainer.student, trainer.average, trainer.optimiser, terms)
    writer = SummaryWriter(str(out / "log"), purge_step=trainer.step) if rank == 0 else None
    bar = ProgressBar(settings.steps, trainer.step) if rank == 0 else None
    while trainer.step < last:
        values = trainer.advance()
        if writer is None or bar is None:
            continue
        bar.advance(f"loss {values['total']:.3f}")
        if trainer.step % LOG_STEPS == 0:
            for name, value in values.items():
                writer.add_scalar(f"loss/{name}", value, trainer.step)
        if trainer.step % CHECKPOINT_STEPS == 0 or trainer.step == last:
            measured = measure(trainer.averaged(), held_out)
            for name, value in measured.items():
                writer.add_scalar(f"held_out/{name}", value, trainer.step)
            bar.note(f"step {trainer.step}: " + ", ".join(f"{name} {value:.3f}" for name, value in measured.items()))
            save_checkpoint(
                checkpoint, trainer.student, trainer.average, trainer.optimiser, {"training": terms, "step": trainer.step}
            )
            notes = {**terms, "step": trainer.step, "held_out": measured}
            weights = trainer.averaged().state_dict()
            save_student(out / "student.safetensors", weights, trainer.student.settings, notes, storage)
    if writer is not None and bar is not None:
        writer.close()
        bar.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    rank, world = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    torch.set_num_threads(options.threads)
    try:
        names = [name for name in TrainingSettings.__dataclass_fields__ if getattr(options, name, None) is not None]
        settings = TrainingSettings(**{name: getattr(options, name) for name in names})
        if world > 1:
            distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        if rank == 0:
            with RunFolder(options.out, settings.to_dict(), "a student's training"):
                run(settings, options.data, options.out, rank, world, options.begin_with, options.until, options.store_as)
        else:
            run(settings, options.data, options.out, rank, world, options.begin_with, options.until, options.store_as)
    except FlockError as fault:
        print(f"learned.student.train: {fault}", file=sys.stderr)
        return 2
    finally:
        if distributed.is_initialized():
            distributed.destroy_process_group()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learned.student.train", description=(__doc__ or "").split("\n")[0])
    defaults = TrainingSettings()
    parser.add_argument("--config", choices=CONFIGS, help=f"(default {defaults.config})")
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders with demonstrations")
    parser.add_argument("--out", type=Path, required=True, help="folder for weights, checkpoint and log")
    parser.add_argument("--begin-with", type=Path, metavar="WEIGHTS", help="fine-tune a student's weights")
    parser.add_argument("--until", type=int, metavar="STEP", help="stop there, before the schedule's end")
    parser.add_argument("--precision", choices=PRECISIONS, help=f"(default {defaults.precision})")
    parser.add_argument("--store-as", choices=STORAGES, default=STORAGES[0], help=f"of the weights (default {STORAGES[0]})")
    parser.add_argument("--threads", type=int, default=1, help="of torch, for each process (default 1)")
    for name in ("steps", "scenes_per_step", "warmup_steps", "seed"):
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, help=f"(default {getattr(defaults, name)})")
    for name in ("learning_rate", "ema_decay", "clearance_weight", "clearance_from", "allocation_weight"):
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, help=f"(default {getattr(defaults, name):g})")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
