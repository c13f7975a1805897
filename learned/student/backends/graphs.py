"""The student as two graphs from tensors to tensors, and what stands in for a student by running them.

Both take any number of scenes, drones, tasks, rows, legs and tries. They are traced from the modules themselves, so there
is one definition of the network whoever computes it.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from flockopt.errors import SettingsError
from learned.student.network.model import Student
from learned.student.network.rows import Rows
from learned.student.network.scene_encoder import AgentTokens
from learned.student.scenes.batch import FleetBatch, with_nothing_else

__all__ = ["OF_DRONES", "OF_SCENES", "OF_TASKS", "GraphStudent", "Head", "Sampler", "TracedStudent"]

#: What the head reads of a batch and its ways: tensors (B, N, ...), (B, M, ...) and (B, ...).
OF_DRONES = ("starts", "ends", "has_end", "capacities", "drone_mask", "needs")
OF_TASKS = ("tasks", "demands", "task_mask")
OF_SCENES = ("lower", "upper")
OF_HEAD = (*OF_DRONES, *OF_TASKS, *OF_SCENES)


class Head(nn.Module):
    """From `OF_DRONES`, `OF_TASKS` and `OF_SCENES` to log-probabilities and the tokens behind them."""

    def __init__(self, student: Student) -> None:
        super().__init__()
        self.student = student

    def forward(self, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, M, N), (B, N, D) and (B, M, D)."""
        log_probs, tokens = self.student.decide(with_nothing_else(dict(zip(OF_HEAD, tensors, strict=True))))
        return log_probs, *tokens


class Sampler(nn.Module):
    """From the fields of `Rows` and noise (R, T, 3) to residuals of this shape."""

    def __init__(self, student: Student, steps: int) -> None:
        super().__init__()
        self.student, self.steps = student, steps

    def forward(self, *tensors: Tensor) -> Tensor:
        """(R, T, 3)."""
        return self.student.sample(Rows(*tensors[:-1]), tensors[-1], self.steps)


class GraphStudent(ABC):
    """Stands in for a `Student` in `learned.student.inference`.

    Args:
        student: One that draws drones each on its own.

    Raises:
        SettingsError: If the student has fleet attention, or another frame than the legs'.
    """

    draws_rows = True

    def __init__(self, student: Student) -> None:
        if not student.draws_rows:
            value = "has fleet attention, places in the list, or another frame than the legs'"
            raise SettingsError("student", value, "must draw each drone on its own", "use the backend torch-eager")
        self.settings = student.settings
        self.student = student.eval()

    def allocate(self, batch: FleetBatch) -> Tensor:
        """As `Student.allocate`."""
        return self.decide(batch)[0]

    def decide(self, batch: FleetBatch) -> tuple[Tensor, AgentTokens]:
        """As `Student.decide`."""
        inputs = tuple(getattr(batch if hasattr(batch, name) else batch.ways, name) for name in OF_HEAD)
        log_probs, drones, tasks = self.run_head(inputs)
        return log_probs, AgentTokens(drones, tasks)

    def sample(self, rows: Rows, noise: Tensor, steps: int) -> Tensor:
        """As `Student.sample`."""
        return self.run_sampler(steps, (*rows, noise))

    def draw(self, batch: FleetBatch, scene: Tensor, drone: Tensor, noise: Tensor, steps: int) -> Tensor:
        """As `Student.draw`, by the student itself."""
        return self.student.draw(batch, scene, drone, noise, steps)

    @abstractmethod
    def run_head(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """What `Head` gives."""

    @abstractmethod
    def run_sampler(self, steps: int, inputs: tuple[Tensor, ...]) -> Tensor:
        """What `Sampler` gives."""


class TracedStudent(GraphStudent):
    """Runs the graphs by torch: its operations without Python in between, the weights frozen as they are now."""

    def __init__(self, student: Student) -> None:
        super().__init__(student.ready())
        self._head: Any = None
        self._samplers: dict[int, Any] = {}

    def run_head(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """What `Head` gives."""
        if self._head is None:
            self._head = _frozen(Head(self.student), inputs)
        return _run(self._head, inputs)

    def run_sampler(self, steps: int, inputs: tuple[Tensor, ...]) -> Tensor:
        """What `Sampler` gives."""
        if steps not in self._samplers:
            self._samplers[steps] = _frozen(Sampler(self.student, steps), inputs)
        return _run(self._samplers[steps], inputs)


def _run(graph: Any, inputs: tuple[Tensor, ...]) -> Any:
    # Optimised execution would watch the first run and take a tenth of a second over the second one, for nothing.
    with torch.jit.optimized_execution(False), torch.inference_mode():  # type: ignore[attr-defined]  # torch has no stub
        return graph(*inputs)


def _frozen(module: nn.Module, inputs: tuple[Tensor, ...]) -> Any:
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of tracing: sizes of layers are constants; and that torch.export will replace it
        return torch.jit.freeze(torch.jit.trace(module.eval(), inputs, check_trace=False))
