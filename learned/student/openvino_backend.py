"""The student compiled by OpenVINO: the same outputs, sooner.

Head and sampler are each one graph of any number of scenes, drones, tasks and obstacles, traced from the torch modules,
compiled once a process for this machine and one thread.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from flockopt.errors import MissingExtra, SettingsError
from learned.student.batch import FAR_AWAY_M, MOST_OBSTACLES, FleetBatch, Ways
from learned.student.model import Student

__all__ = ["OpenVinoStudent"]

WAYS = tuple(field.name for field in dataclasses.fields(Ways) if field.name != "target")
FLEET = tuple(field.name for field in dataclasses.fields(FleetBatch) if field.name != "ways")


class OpenVinoStudent:
    """Stands in for a `Student` in `learned.student.inference`.

    Args:
        student: One without fleet attention.
        precision: ``f32``, whose outputs differ from torch's by rounding, or ``bf16``.

    Raises:
        MissingExtra: If openvino is not installed.
        SettingsError: If the student has fleet attention, or the precision is another.
    """

    def __init__(self, student: Student, precision: str = "f32") -> None:
        if student.settings.fleet_attention:
            raise SettingsError("student", "has fleet attention", "must draw each drone on its own", "use torch")
        if precision not in ("f32", "bf16"):
            raise SettingsError("precision", f"is {precision!r}", "must be f32 or bf16", "choose one")
        self.settings = student.settings
        self._student, self._precision = student, precision
        self._compiled = cache(self._compile)

    def allocate(self, batch: FleetBatch) -> Tensor:
        """As `Student.allocate`."""
        return self._run(_Head, 0, _tensors(batch))

    def draw(self, batch: FleetBatch, scene: Tensor, drone: Tensor, noise: Tensor, steps: int) -> Tensor:
        """As `Student.draw`."""
        return self._run(_Sampler, steps, (*_tensors(batch), scene, drone, noise))

    def _run(self, kind: type[_Head | _Sampler], steps: int, inputs: tuple[Tensor, ...]) -> Tensor:
        with torch.inference_mode():
            request = self._compiled(kind, steps, _Inputs(inputs))
        (answer,) = request([value.numpy() for value in inputs]).values()
        return torch.from_numpy(np.array(answer))

    def _compile(self, kind: type[_Head | _Sampler], steps: int, example: _Inputs) -> Any:
        try:
            import openvino
        except ImportError:
            raise MissingExtra("openvino", "openvino") from None
        module = kind(self._student, steps).eval()
        with torch.no_grad():
            graph = openvino.convert_model(module, example_input=example.tensors)
        settings = {"INFERENCE_PRECISION_HINT": self._precision, "INFERENCE_NUM_THREADS": 1, "PERFORMANCE_HINT": "LATENCY"}
        return openvino.Core().compile_model(graph, "CPU", settings)


class _Inputs:
    """Example inputs, all of them equal for a cache: graphs take any sizes."""

    def __init__(self, tensors: tuple[Tensor, ...]) -> None:
        self.tensors = tuple(tensor.clone() for tensor in tensors)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Inputs)

    def __hash__(self) -> int:
        return 0


class _Head(nn.Module):
    """From a batch's tensors to log-probabilities."""

    def __init__(self, student: Student, steps: int) -> None:
        super().__init__()
        self.student = student

    def forward(self, *tensors: Tensor) -> Tensor:
        return self.student.allocate(_batch(tensors))


class _Sampler(nn.Module):
    """From a batch's tensors, the drones' places and noise to points."""

    def __init__(self, student: Student, steps: int) -> None:
        super().__init__()
        self.student, self.steps = student, steps

    def forward(self, *tensors: Tensor) -> Tensor:
        *whole, scene, drone, noise = tensors
        return self.student.draw(_batch(whole), scene, drone, noise, self.steps)


def _tensors(batch: FleetBatch) -> tuple[Tensor, ...]:
    """A batch's tensors in a fixed order, with as many obstacles as the sampler takes at least."""
    ways = batch.ways
    missing = max(MOST_OBSTACLES + 1 - ways.obstacles.shape[1], 0)
    padded = dataclasses.replace(
        ways,
        obstacles=pad(ways.obstacles, (0, 0, 0, missing), value=FAR_AWAY_M),
        obstacle_mask=pad(ways.obstacle_mask, (0, missing), value=False),
    )
    return (*(getattr(batch, name) for name in FLEET), *(getattr(padded, name) for name in WAYS))


def _batch(tensors: tuple[Tensor, ...] | list[Tensor]) -> FleetBatch:
    """The inverse of `_tensors`."""
    fleet = dict(zip(FLEET, tensors[: len(FLEET)], strict=True))
    return FleetBatch(**fleet, ways=Ways(**dict(zip(WAYS, tensors[len(FLEET) :], strict=True))))
