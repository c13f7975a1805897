"""Training from beginning to end: problems of many sizes, checkpoints that go on exactly, a history for the curves."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from flockopt.errors import SettingsError
from flockopt.records import checks, files
from learned.networks.weight_files import load_weights, save_weights
from learned.teacher.actors.critic import CentralCritic
from learned.teacher.actors.networks import make_actor, set_tensors
from learned.teacher.episodes import play
from learned.teacher.problems import Problems, random_problems
from learned.teacher.training.ppo_learner import PPOLearner
from learned.teacher.training.scene_pool import ScenePool
from learned.teacher.training.settings import AllocatorTrainingSettings
from learned.teacher.training.validation import ValidationSet

__all__ = ["EVALUATE_EVERY", "Training", "final_weights"]

#: Drones and tasks of the batches; those that stand here more often are drawn more often.
SIZES = ((10, 20),) * 5 + ((6, 12), (8, 20), (12, 20), (14, 20), (10, 15), (10, 30), (5, 16), (16, 28))

#: The size that ``batch_size`` counts episodes of.
USUAL_SIZE = 10 * 20

#: Iterations between measurements on the validation scenes, and between checkpoints.
EVALUATE_EVERY = 10

CHECKPOINT, HISTORY = "checkpoint.safetensors", "history.jsonl"


def final_weights(folder: Path, method: str) -> Path:
    """Where a finished training leaves its weights."""
    return folder / f"{method}.safetensors"


@dataclass(frozen=True)
class _Names:
    """Prefixes of the tensors in a checkpoint."""

    actor: str = "actor."
    critic: str = "critic."
    optimiser: str = "optimiser."
    generator: str = "generator"


class Training:
    """A training run in a folder; it goes on where it stopped.

    Args:
        settings: How to train.
        pool: Training scenes.
        folder: For checkpoint, history and final weights.
        validation: What the curves are measured on.

    Raises:
        SettingsError: If the folder holds a run with other settings, or a damaged checkpoint.
    """

    def __init__(self, settings: AllocatorTrainingSettings, pool: ScenePool, folder: Path, validation: ValidationSet) -> None:
        self.settings, self.pool, self.folder, self.validation = settings, pool, folder, validation
        self.iteration = 0
        self.history: list[dict[str, float]] = []
        self.generator = torch.Generator().manual_seed(settings.seed)
        with torch.random.fork_rng():
            torch.manual_seed(settings.seed)
            self.actor = make_actor(settings.method, settings.width)
            self.critic = CentralCritic(settings.width, self.actor.memory_width)
        self.learner = PPOLearner(self.actor, self.critic, settings, self.generator)
        if (folder / CHECKPOINT).exists():
            self._resume()
        else:
            self._measure()

    def run(self, report: Callable[[dict[str, float]], None] = lambda row: None, *, stop_at: int | None = None) -> None:
        """Train to the end, or to iteration ``stop_at``; ``report`` is told the figures of each iteration."""
        last = self.settings.iterations if stop_at is None else min(stop_at, self.settings.iterations)
        while self.iteration < last:
            share_left = 1.0 - self.iteration / self.settings.iterations
            figures = self.learner.iterate(self._draw(self.settings.batch_size), share_left)
            self.iteration += 1
            row = {"iteration": float(self.iteration), **asdict(figures)}
            if self.iteration % EVALUATE_EVERY == 0 or self.iteration == self.settings.iterations:
                row["excess"], row["greedy_steps"] = self.validation.excess(self.actor)
            self.history.append(row)
            report(row)
            if "excess" in row:
                self._save()
        if self.iteration == self.settings.iterations:
            path = final_weights(self.folder, self.settings.method)
            save_weights(path, self.actor.state_dict(), self.settings.method, self._described())

    def _described(self) -> dict[str, Any]:
        """What the header of the final weights says of them."""
        return {"width": self.settings.width, "training": asdict(self.settings), "excess": self.history[-1]["excess"]}

    def _draw(self, batch_size: int) -> Problems:
        drones, tasks = SIZES[int(torch.randint(len(SIZES), (1,), generator=self.generator))]
        count = max(round(batch_size * USUAL_SIZE / (drones * tasks)), 2)
        from_pool = min(max(round(count * self.settings.pool_share), 0), count)
        parts = [self.pool.draw(from_pool, drones, tasks, self.generator)] if from_pool else []
        if from_pool < count:
            parts.append(random_problems(count - from_pool, drones, tasks, self.generator))
        return Problems.cat(parts)

    def _measure(self) -> None:
        """Let the normalisers see what the new actor sees."""
        with torch.no_grad():
            seen = [
                moment.observed
                for _ in range(8)
                for moment in play(self.actor, self._draw(32), generator=self.generator, slots=self.settings.slots)
            ]
        self.actor.normaliser.measure(seen)
        self.critic.normaliser.measure(seen)

    # -- checkpoints ----------------------------------------------------------------------------------------

    def _save(self) -> None:
        names = _Names()
        tensors = {names.actor + name: tensor for name, tensor in self.actor.state_dict().items()}
        tensors |= {names.critic + name: tensor for name, tensor in self.critic.state_dict().items()}
        for index, state in self.learner.optimiser.state_dict()["state"].items():
            tensors |= {f"{names.optimiser}{index}.{name}": tensor for name, tensor in state.items()}
        tensors[names.generator] = self.generator.get_state()
        lines = "".join(json.dumps(row) + "\n" for row in self.history)
        files.write_whole(SettingsError, self.folder / HISTORY, lines)
        described = {"iteration": self.iteration, "training": asdict(self.settings)}
        save_weights(self.folder / CHECKPOINT, tensors, self._kind, described)

    @property
    def _kind(self) -> str:
        return f"{self.settings.method}-checkpoint"

    def _resume(self) -> None:
        path = self.folder / CHECKPOINT
        tensors, described = load_weights(path, self._kind)
        if described.get("training") != asdict(self.settings):
            value = f"{self.folder} holds a training with other settings"
            raise SettingsError("out", value, "a run goes on with the settings it began with", "choose another folder")
        names = _Names()
        set_tensors(self.actor, _part(tensors, names.actor), str(path))
        set_tensors(self.critic, _part(tensors, names.critic), str(path))
        self._resume_optimiser(_part(tensors, names.optimiser))
        self.generator.set_state(tensors[names.generator])
        self.iteration = checks.integer(SettingsError, "iteration", described.get("iteration"), least=0)
        self.history = self._read_history()

    def _read_history(self) -> list[dict[str, float]]:
        """The figures of the iterations up to the checkpoint's."""
        path = self.folder / HISTORY
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as fault:
            rule = "a run goes on with its history"
            raise SettingsError("out", f"{path} cannot be read ({fault})", rule, "choose another folder") from None
        return [files.parse_json(SettingsError, line, str(path)) for line in lines[: self.iteration]]

    def _resume_optimiser(self, tensors: dict[str, Tensor]) -> None:
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in tensors.items():
            index, _, field = name.partition(".")
            state.setdefault(int(index), {})[field] = tensor
        optimiser = self.learner.optimiser
        optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
