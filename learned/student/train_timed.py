"""Train the network of timed flights from timed demonstrations.

    python -m learned.student.train_timed --data runs/timed --out runs/timed-student

Killed and started again, it goes on from its last checkpoint and ends with the same weights. Writes
``checkpoint.safetensors``, ``student-timed.safetensors`` (averaged weights, for `learned.student.timed_smoother`) and logs
for TensorBoard. Exit status 0, or 2 on bad input.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from flockopt import FlockError, SettingsError
from flockopt.progress_bar import ProgressBar
from flockopt.run_folder import RunFolder
from learned.student.checkpoint import restore, save_checkpoint
from learned.student.schedule import is_bfloat16, rate_at
from learned.student.timed_batch import MOST_JOINTS, UnitStage, collate_stages, unit_stage
from learned.student.timed_checkpoint import load_timed, save_timed
from learned.student.timed_frame import flat_frames, residuals
from learned.student.timed_loss import TimedLoss, verdicts
from learned.student.timed_model import TimedNetwork
from learned.student.timed_settings import MODES, TimedNetworkSettings, TimedTrainingSettings
from learned.student.training_settings import PRECISIONS
from learned.timed_shards import load_stages

__all__ = ["TimedTrainer", "main", "measure"]

#: Of the stages, this share, but not more than so many, is held out to measure on.
HELD_OUT_SHARE, MOST_HELD_OUT = 0.05, 256

#: Steps between measurements with a checkpoint, and between lines in the log.
CHECKPOINT_STEPS, LOG_STEPS = 250, 25

#: So many steps' stages are sorted by length, so that those of one step are alike and little is padded.
SORTED_STEPS = 16

#: Stages that residuals' spread is measured on.
SPREAD_STAGES = 2048


class TimedTrainer:
    """The state of a run, and one step of it.

    Args:
        settings: Of the run.
        stages: To learn from.
    """

    def __init__(self, settings: TimedTrainingSettings, stages: Sequence[UnitStage]) -> None:
        self.settings, self.stages, self.step = settings, stages, 0
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.manual_seed(settings.seed)
        self.network = TimedNetwork(TimedNetworkSettings(mode=settings.mode))
        self.network.spread.copy_(_spread(stages))
        self.network.to(self.device)
        self.average = {name: value.detach().clone() for name, value in self.network.state_dict().items()}
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, betas=(0.9, 0.99)
        )
        self.loss = TimedLoss(self.network)
        self._order: tuple[int, list[list[int]]] = (-1, [])

    def begin_with(self, path: Path | None) -> str | None:
        """Take the weights of a file, if one is given; the file's name."""
        if path is None:
            return None
        network = load_timed(path)
        if network.settings != self.network.settings:
            value, rule = f"holds weights for mode {network.settings.mode!r} ({path})", f"must be for {self.settings.mode!r}"
            raise SettingsError("begin_with", value, rule, "choose the mode they are for")
        for name, value in network.state_dict().items():
            self.network.state_dict()[name].copy_(value)
            self.average[name].copy_(value)
        return path.name

    def advance(self) -> dict[str, float]:
        """One step of the optimiser; the loss's terms."""
        settings = self.settings
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + self.step)
        batch = collate_stages([self.stages[index] for index in self._chosen()]).to(self.device)
        batch = batch.mirrored() if bool(torch.rand((), generator=generator) < 0.5) else batch
        for group in self.optimiser.param_groups:
            group["lr"] = settings.learning_rate * rate_at(self.step, settings.steps, settings.warmup_steps)
        is_first_part = self.step < settings.cost_from * settings.steps
        imitation, cost = (1.0, 0.0) if is_first_part else (settings.imitation_weight, 1.0)
        # stages are short, and of the fused kernels the backward pass in bfloat16 is several times slower on CPUs
        with sdpa_kernel(SDPBackend.MATH):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=is_bfloat16(settings.precision, self.device)):
                total, terms = self.loss(batch, imitation, cost, settings.room_m, generator)
            self.optimiser.zero_grad()
            total.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), settings.clip)
        self.optimiser.step()
        self.step += 1
        self._average()
        return {name: float(value) for name, value in {"total": total.detach(), **terms}.items()}

    def _chosen(self) -> list[int]:
        """The stages of this step: every epoch has all of them in a new order, those of a step being about as long."""
        steps_an_epoch = math.ceil(len(self.stages) / self.settings.stages_per_step)
        epoch, place = divmod(self.step, steps_an_epoch)
        if self._order[0] != epoch:
            self._order = (epoch, self._shuffled(np.random.default_rng([self.settings.seed, epoch])))
        return self._order[1][place]

    def _shuffled(self, rng: np.random.Generator) -> list[list[int]]:
        each, order = self.settings.stages_per_step, rng.permutation(len(self.stages)).tolist()
        steps = []
        for first in range(0, len(order), SORTED_STEPS * each):
            part = sorted(order[first : first + SORTED_STEPS * each], key=lambda index: len(self.stages[index].states))
            steps += [part[begin : begin + each] for begin in range(0, len(part), each)]
        return [steps[index] for index in rng.permutation(len(steps))]

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.settings.ema_decay, (1 + self.step) / (10 + self.step))
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value.to(self.average[name].dtype), 1.0 - decay)

    def averaged(self) -> TimedNetwork:
        """A network with the averaged weights, on the CPU."""
        network = TimedNetwork(self.network.settings)
        network.load_state_dict({name: value.cpu() for name, value in self.average.items()})
        return network.eval()


@torch.no_grad()
def measure(network: TimedNetwork, stages: Sequence[UnitStage], room_m: float = 0.0) -> dict[str, float]:
    """Of one proposal a stage: the share that would be accepted, the mean cost where the others stay, the teacher's."""
    batch = collate_stages(stages)
    none = torch.zeros_like(batch.need)
    noise = torch.randn(*batch.joints.shape, 10, generator=torch.Generator().manual_seed(0))
    proposed = verdicts(batch, *network.propose(batch, none + room_m / batch.length_m, noise), none)
    teacher = verdicts(batch, batch.teacher_states, batch.teacher_durations, none)
    cost = torch.where(proposed.accepted, proposed.cost, 1.0)
    return {
        "accepted": float(proposed.accepted.float().mean()),
        "clear": float((proposed.intrusion.amax(dim=(1, 2)) <= 0.0).float().mean()),
        "raw_cost": float(proposed.cost.median()), "cost": float(cost.mean()), "teacher_cost": float(teacher.cost.mean()),
    }  # fmt: skip


@torch.no_grad()
def _spread(stages: Sequence[UnitStage]) -> Tensor:
    """(10,): root mean squares of the teacher's residuals, over some of the stages."""
    batch = collate_stages(stages[:SPREAD_STAGES])
    changes = residuals(batch, flat_frames(batch))[batch.inner]
    return changes.square().mean(dim=0).sqrt().clamp(min=1e-3) if len(changes) else torch.ones(10)


def run(settings: TimedTrainingSettings, data: Sequence[Path], out: Path, begin_with: Path | None, until: int | None) -> None:
    """Train to the end, or ``until`` a step, going on from a checkpoint if there is one."""
    from torch.utils.tensorboard import SummaryWriter

    records = [record for folder in data for record in load_stages(folder)]
    stages = [unit_stage(record) for record in records if len(record.states) <= MOST_JOINTS]
    order = np.random.default_rng(settings.seed).permutation(len(stages))
    num_held_out = min(MOST_HELD_OUT, math.ceil(HELD_OUT_SHARE * len(stages)))
    held_out = [stages[index] for index in order[:num_held_out]]
    trainer = TimedTrainer(settings, [stages[index] for index in order[num_held_out:]] or held_out)
    terms = {"settings": settings.to_dict(), "stages": len(stages), "begin_with": trainer.begin_with(begin_with)}
    checkpoint = out / "checkpoint.safetensors"
    if checkpoint.exists():
        trainer.step = restore(checkpoint, trainer.network, trainer.average, trainer.optimiser, terms)
    last = settings.steps if until is None else min(until, settings.steps)
    writer, bar = SummaryWriter(str(out / "log"), purge_step=trainer.step), ProgressBar(settings.steps, trainer.step)
    while trainer.step < last:
        values = trainer.advance()
        bar.advance(f"loss {values['total']:.3f}")
        if trainer.step % LOG_STEPS == 0:
            for name, value in values.items():
                writer.add_scalar(f"loss/{name}", value, trainer.step)
        if trainer.step % CHECKPOINT_STEPS == 0 or trainer.step == last:
            measured = measure(trainer.averaged(), held_out)
            for name, value in measured.items():
                writer.add_scalar(f"held_out/{name}", value, trainer.step)
            bar.note(f"step {trainer.step}: " + ", ".join(f"{name} {value:.3f}" for name, value in measured.items()))
            header = {"training": terms, "step": trainer.step}
            save_checkpoint(checkpoint, trainer.network, trainer.average, trainer.optimiser, header)
            notes = {**terms, "step": trainer.step, "held_out": measured}
            averaged = trainer.averaged()
            save_timed(out / "student-timed.safetensors", averaged.state_dict(), averaged.settings, notes)
    writer.close()
    bar.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    try:
        names = [name for name in TimedTrainingSettings.__dataclass_fields__ if getattr(options, name, None) is not None]
        settings = TimedTrainingSettings(**{name: getattr(options, name) for name in names})
        with RunFolder(options.out, settings.to_dict(), "a training of timed flights"):
            run(settings, options.data, options.out, options.begin_with, options.until)
    except FlockError as fault:
        print(f"learned.student.train_timed: {fault}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learned.student.train_timed", description=(__doc__ or "").split("\n")[0])
    defaults = TimedTrainingSettings()
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders with timed demonstrations")
    parser.add_argument("--out", type=Path, required=True, help="folder for weights, checkpoint and log")
    parser.add_argument("--mode", choices=MODES, help=f"(default {defaults.mode})")
    parser.add_argument("--begin-with", type=Path, metavar="WEIGHTS", help="fine-tune the weights of a file")
    parser.add_argument("--until", type=int, metavar="STEP", help="stop there, before the schedule's end")
    parser.add_argument("--precision", choices=PRECISIONS, help=f"(default {defaults.precision})")
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    for name in ("steps", "stages_per_step", "warmup_steps", "seed"):
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, help=f"(default {getattr(defaults, name)})")
    for name in ("learning_rate", "ema_decay", "cost_from", "imitation_weight", "room_m"):
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, help=f"(default {getattr(defaults, name):g})")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
