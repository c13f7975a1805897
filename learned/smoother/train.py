"""Train the network of timed flights from timed demonstrations.

    python -m learned.smoother.train --data runs/timed --out runs/timed-student

Killed and started again, it goes on from its last checkpoint and ends with the same weights. Writes
``checkpoint.safetensors``, ``student-timed.safetensors`` (averaged weights, for `learned.smoother.smoother`) and logs
for TensorBoard. Exit status 0, or 2 on bad input.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flockopt.batches.run_folder import RunFolder
from flockopt.cli.status import run_command
from learned.demonstrations.timed_shards import load_stages
from learned.networks.training import Learner, Run, add_run_options, held_out, settings_of
from learned.smoother.batch import MOST_JOINTS, UnitStage, collate_stages, unit_stage
from learned.smoother.checkpoint import load_timed, save_timed
from learned.smoother.frame import flat_frames, residuals
from learned.smoother.loss import TimedLoss, verdicts
from learned.smoother.model import TimedNetwork
from learned.smoother.settings import MODES, TimedNetworkSettings, TimedTrainingSettings

__all__ = ["TimedTrainer", "main", "measure"]

#: Stages that are held out at the most, to measure on.
MOST_HELD_OUT = 256

#: So many steps' stages are sorted by length, so that those of one step are alike and little is padded.
SORTED_STEPS = 16

#: Stages that residuals' spread is measured on.
SPREAD_STAGES = 2048


class TimedTrainer(Learner[TimedNetwork]):
    """The state of a training of timed flights, and one step of it.

    Args:
        settings: Of the run.
        stages: To learn from.
    """

    def __init__(self, settings: TimedTrainingSettings, stages: Sequence[UnitStage]) -> None:
        self.settings, self.stages = settings, stages
        torch.manual_seed(settings.seed)
        network = TimedNetwork(TimedNetworkSettings(mode=settings.mode))
        network.spread.copy_(_spread(stages))
        super().__init__(network, settings, torch.device("cuda" if torch.cuda.is_available() else "cpu"))
        self.loss = TimedLoss(network)
        self._order: tuple[int, list[list[int]]] = (-1, [])

    def _losses(self) -> tuple[Tensor, dict[str, Tensor]]:
        settings = self.settings
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + self.step)
        batch = collate_stages([self.stages[index] for index in self._chosen()]).to(self.device)
        batch = batch.mirrored() if bool(torch.rand((), generator=generator) < 0.5) else batch
        is_first_part = self.step < settings.cost_from * settings.steps
        imitation, cost = (1.0, 0.0) if is_first_part else (settings.imitation_weight, 1.0)
        return self.loss(batch, imitation, cost, settings.room_m, generator)

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
    records = [record for folder in data for record in load_stages(folder)]
    stages = [unit_stage(record) for record in records if len(record.states) <= MOST_JOINTS]
    taught, kept = held_out(stages, settings.seed, MOST_HELD_OUT)
    trainer = TimedTrainer(settings, taught)
    begun = trainer.begin_with(begin_with, load_timed)
    terms = {"settings": settings.to_dict(), "stages": len(stages), "begin_with": begun}

    def save(network: TimedNetwork, notes: dict[str, Any]) -> None:
        save_timed(out / "student-timed.safetensors", network.state_dict(), network.settings, notes)

    whole = Run(trainer, out, terms, partial(measure, stages=kept), save)
    whole.until(settings.steps if until is None else min(until, settings.steps))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    return run_command("learned.smoother.train", lambda: _train(options))


def _train(options: argparse.Namespace) -> None:
    settings = settings_of(options, TimedTrainingSettings)
    with RunFolder(options.out, settings.to_dict(), "a training of timed flights"):
        run(settings, options.data, options.out, options.begin_with, options.until)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learned.smoother.train", description=(__doc__ or "").split("\n")[0])
    defaults = TimedTrainingSettings()
    parser.add_argument("--mode", choices=MODES, help=f"(default {defaults.mode})")
    whole = ("steps", "stages_per_step", "warmup_steps", "seed")
    add_run_options(parser, defaults, whole, ("learning_rate", "ema_decay", "cost_from", "imitation_weight", "room_m"))
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
