"""What the trainings of this package share: a network with its average and its optimiser, a step, a run that can be stopped."""

from __future__ import annotations

import argparse
import copy
import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from flockopt.batches.progress import ProgressBar
from flockopt.errors import SettingsError
from learned.networks.checkpoint import restore, save_checkpoint
from learned.networks.schedule import PRECISIONS, Schedule
from learned.networks.weight_files import file_digest

__all__ = ["Learner", "Run", "add_run_options", "held_out", "is_bfloat16", "settings_of"]

#: Of the examples, this share is held out to measure on.
HELD_OUT_SHARE = 0.05

#: Steps between measurements with a checkpoint, and between lines in the log.
CHECKPOINT_STEPS, LOG_STEPS = 250, 25

#: On the few tokens of a drone the fused kernels' backward pass takes several times longer, in bfloat16 on CPUs.
SHORT_SEQUENCES = [SDPBackend.MATH]

Item = TypeVar("Item")
Settings = TypeVar("Settings", bound=Schedule)


Trained = TypeVar("Trained", bound=nn.Module)


class Learner(ABC, Generic[Trained]):
    """The state of a training, and one step of it.

    Args:
        network: What learns; made after `torch.manual_seed`, so that equal seeds give equal weights.
        settings: Of the run.
        device: Where.
    """

    #: What may compute attention.
    attention = SHORT_SEQUENCES

    def __init__(self, network: Trained, settings: Schedule, device: torch.device) -> None:
        self.network, self._schedule, self.device, self.step = network.to(device), settings, device, 0
        self.average = {name: value.detach().clone() for name, value in network.state_dict().items()}
        self.optimiser = torch.optim.AdamW(
            network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, betas=(0.9, 0.99)
        )

    @abstractmethod
    def _losses(self) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of this step, and its terms by name; called under autocast."""

    def begin_with(self, path: Path | None, load: Callable[[Path], Any]) -> str | None:
        """Take the weights of a file that ``load`` reads, if one is given; the file's digest.

        Raises:
            SettingsError: If it holds weights for other settings.
        """
        if path is None:
            return None
        given = load(path)
        if given.settings != self.network.settings:
            value, rule = f"holds weights for other settings ({path})", "must be for the network that is trained"
            raise SettingsError("begin_with", value, rule, "choose the configuration they are for")
        for name, value in given.state_dict().items():
            self.network.state_dict()[name].copy_(value)
            self.average[name].copy_(value)
        return file_digest(path)

    def advance(self) -> dict[str, float]:
        """One step of the optimiser; the loss's terms."""
        settings = self._schedule
        for group in self.optimiser.param_groups:
            group["lr"] = settings.rate_at(self.step)
        with sdpa_kernel(self.attention):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=is_bfloat16(settings.precision, self.device)):
                total, terms = self._losses()
            self.optimiser.zero_grad()
            total.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), settings.clip)
        self.optimiser.step()
        self.step += 1
        self._average()
        return {name: float(value) for name, value in {"total": total.detach(), **terms}.items()}

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self._schedule.ema_decay, (1 + self.step) / (10 + self.step))
        for name, value in self.network.state_dict().items():
            self.average[name].lerp_(value.to(self.average[name].dtype), 1.0 - decay)

    def averaged(self) -> Trained:
        """A network with the averaged weights, on the CPU, in evaluation mode."""
        network = copy.deepcopy(self.network).cpu()
        network.load_state_dict({name: value.cpu() for name, value in self.average.items()})
        return network.eval()


class Run(Generic[Trained]):
    """A training with its folder: it goes on from a checkpoint, and writes weights, checkpoints and logs.

    Args:
        learner: What is trained.
        out: The folder.
        terms: What a checkpoint must agree in to be gone on from.
        measure: Figures of a network on what was held out.
        save: Writes a network's weights for inference, with notes.
    """

    def __init__(
        self, learner: Learner[Trained], out: Path, terms: dict[str, Any], measure: Callable[[Trained], dict[str, float]],
        save: Callable[[Trained, dict[str, Any]], None],
    ) -> None:  # fmt: skip
        self._learner, self._checkpoint, self._terms = learner, out / "checkpoint.safetensors", terms
        self._log, self._measure, self._save = out / "log", measure, save
        if self._checkpoint.exists():
            learner.step = restore(self._checkpoint, learner.network, learner.average, learner.optimiser, terms)

    def until(self, last: int, is_silent: bool = False) -> None:
        """Train until a step; in silence, nothing is written."""
        if is_silent:
            while self._learner.step < last:
                self._learner.advance()
            return
        from torch.utils.tensorboard import SummaryWriter

        learner = self._learner
        writer = SummaryWriter(str(self._log), purge_step=learner.step)
        bar = ProgressBar(learner._schedule.steps, learner.step)
        while learner.step < last:
            values = learner.advance()
            bar.advance(f"loss {values['total']:.3f}")
            if learner.step % LOG_STEPS == 0:
                _log(writer, "loss", values, learner.step)
            if learner.step % CHECKPOINT_STEPS == 0 or learner.step == last:
                measured = self._keep()
                _log(writer, "held_out", measured, learner.step)
                bar.note(f"step {learner.step}: " + ", ".join(f"{name} {value:.3f}" for name, value in measured.items()))
        writer.close()
        bar.close()

    def _keep(self) -> dict[str, float]:
        """Write a checkpoint and the averaged weights; what these are worth."""
        learner, average = self._learner, self._learner.averaged()
        measured, header = self._measure(average), {"training": self._terms, "step": learner.step}
        save_checkpoint(self._checkpoint, learner.network, learner.average, learner.optimiser, header)
        self._save(average, {**self._terms, "step": learner.step, "held_out": measured})
        return measured


def _log(writer: Any, group: str, values: dict[str, float], step: int) -> None:
    for name, value in values.items():
        writer.add_scalar(f"{group}/{name}", value, step)


def held_out(items: Sequence[Item], seed: int, most: int) -> tuple[list[Item], list[Item]]:
    """What to learn from and what to measure on, ``most`` at the most; where there is only one, it serves for both."""
    order = np.random.default_rng(seed).permutation(len(items))
    count = min(most, math.ceil(HELD_OUT_SHARE * len(items)))
    chosen = [items[index] for index in order[:count]]
    return [items[index] for index in order[count:]] or chosen, chosen


def add_run_options(parser: argparse.ArgumentParser, defaults: Any, whole: Sequence[str], shares: Sequence[str]) -> None:
    """The options that all trainings have, and one for each of some settings: whole numbers and others."""
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders with demonstrations")
    parser.add_argument("--out", type=Path, required=True, help="folder for weights, checkpoint and log")
    parser.add_argument("--begin-with", type=Path, metavar="WEIGHTS", help="fine-tune the weights of a file")
    parser.add_argument("--until", type=int, metavar="STEP", help="stop there, before the schedule's end")
    parser.add_argument("--precision", choices=PRECISIONS, help=f"(default {defaults.precision})")
    parser.add_argument("--threads", type=int, default=1, help="of torch, for each process (default 1)")
    for name in whole:
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, help=f"(default {getattr(defaults, name)})")
    for name in shares:
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, help=f"(default {getattr(defaults, name):g})")


def settings_of(options: argparse.Namespace, kind: type[Settings]) -> Settings:
    """Settings from the options that were given; the others keep their defaults."""
    names = [field.name for field in dataclasses.fields(kind)]
    return kind(**{name: getattr(options, name) for name in names if getattr(options, name, None) is not None})


def is_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether a run multiplies in bfloat16; ``auto`` does where the hardware has it."""
    if precision != "auto":
        return precision == "bfloat16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())
