"""The student compiled by OpenVINO: the same outputs, sooner.

OpenVINO is fastest where it knows all sizes. So scenes, drones, tasks, rows and legs are padded to a few sizes, and each
graph is compiled once for each of these, for one thread, and kept on disk (`learned.student.backends.compiled_files`),
where the next process finds it.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from flockopt.errors import SettingsError, require
from flockopt.records import checks
from learned.student.backends.compiled_files import CompiledFiles, digest_of
from learned.student.backends.graphs import OF_DRONES, OF_SCENES, OF_TASKS, GraphStudent, Head, Sampler
from learned.student.network.model import Student
from learned.student.network.rows import Rows

__all__ = ["PRECISIONS", "OpenVinoStudent"]

PRECISIONS = ("f32", "bf16")

#: Drones and tasks are padded to multiples of the first, legs to multiples of the second; scenes and rows to powers of two
#: up to the third, and more than that are computed in several goes.
NODES, LEGS, MOST_ROWS = 10, 8, 32

Array: TypeAlias = np.ndarray[Any, Any]
Shape: TypeAlias = tuple[int, ...]


class OpenVinoStudent(GraphStudent):
    """Stands in for a `Student` in `learned.student.inference`.

    Args:
        student: One that draws drones each on its own.
        precision: ``f32``, whose outputs differ from torch's by rounding, or ``bf16``, which is coarser, and sooner where
            the processor multiplies in it.
        folder: Where compiled graphs are kept; None for a folder in the user's caches.

    Raises:
        MissingExtra: If openvino is not installed.
        SettingsError: If the student cannot be compiled, or the precision is another.
    """

    def __init__(self, student: Student, precision: str = "f32", folder: Path | None = None) -> None:
        checks.choice(SettingsError, "precision", precision, known=PRECISIONS)
        super().__init__(student)
        openvino = require("openvino", extra="openvino")
        self._core = openvino.Core()
        self._settings = {
            "INFERENCE_PRECISION_HINT": precision, "INFERENCE_NUM_THREADS": 1, "PERFORMANCE_HINT": "LATENCY",
        }  # fmt: skip
        self._files = CompiledFiles(folder, digest_of(student, openvino.__version__, precision))
        self._graphs: dict[int, Any] = {}
        self._requests: dict[tuple[int, tuple[Shape, ...]], Any] = {}

    def run_head(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """What `Head` gives."""
        drones, tasks = inputs[0].shape[1], inputs[len(OF_DRONES)].shape[1]
        widths = [_multiple(drones, NODES)] * len(OF_DRONES) + [_multiple(tasks, NODES)] * len(OF_TASKS)

        def sizes(scenes: int) -> list[Shape]:
            return [(scenes, width) for width in widths] + [(scenes,)] * len(OF_SCENES)

        log_probs, drone_tokens, task_tokens = self._in_goes(0, inputs, sizes)
        return log_probs[:, :tasks, :drones], drone_tokens[:, :drones], task_tokens[:, :tasks]

    def run_sampler(self, steps: int, inputs: tuple[Tensor, ...]) -> Tensor:
        """What `Sampler` gives."""
        rows = Rows(*inputs[:-1])
        legs, patches = _multiple(rows.goals.shape[1], LEGS), rows.shares.shape[1]

        def sizes(count: int) -> list[Shape]:
            return [(count,), (count, legs), (count, legs), (count,), (count, patches, legs), (count,), (count,)]

        (residuals,) = self._in_goes(steps, inputs, sizes)
        return residuals

    def _in_goes(self, steps: int, inputs: Sequence[Tensor], sizes: Callable[[int], list[Shape]]) -> list[Tensor]:
        """The outputs for all rows of the inputs, at most `MOST_ROWS` at a time.

        Args:
            steps: Of the sampler; 0 for the head.
            inputs: (R, ...) each.
            sizes: What the first axes of each input are padded to, from a padded number of rows.
        """
        goes = []
        for begin in range(0, len(inputs[0]), MOST_ROWS):
            part = [tensor[begin : begin + MOST_ROWS].numpy() for tensor in inputs]
            count = len(part[0])
            padded = [_padded(*pair) for pair in zip(part, sizes(_power_of_two(count)), strict=True)]
            answers = self._request(steps, padded).infer(padded, share_inputs=True, share_outputs=True).values()
            goes.append([np.array(answer[:count]) for answer in answers])
        return [torch.from_numpy(np.concatenate(parts)) for parts in zip(*goes, strict=True)]

    def _request(self, steps: int, inputs: Sequence[Array]) -> Any:
        """What answers inputs of these shapes; compiled where nothing did before."""
        key = steps, tuple(array.shape for array in inputs)
        if key not in self._requests:
            kept = self._files.read(repr(key))
            if kept is None:
                compiled = self._core.compile_model(self._graph(steps, inputs), "CPU", self._settings)
                self._files.write(repr(key), compiled.export_model().getvalue())
            else:
                compiled = self._core.import_model(io.BytesIO(kept), "CPU", self._settings)
            self._requests[key] = compiled.create_infer_request()
        return self._requests[key]

    def _graph(self, steps: int, inputs: Sequence[Array]) -> Any:
        """The head or the sampler as OpenVINO's graph, for inputs of these shapes."""
        import openvino

        if steps not in self._graphs:
            module = Sampler(self.student, steps) if steps else Head(self.student)
            examples = tuple(torch.from_numpy(array.copy()) for array in inputs)
            with torch.no_grad(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of tracing, that sizes of layers are constants
                self._graphs[steps] = openvino.convert_model(module.eval(), example_input=examples)
        graph = self._graphs[steps].clone()
        graph.reshape({place: list(array.shape) for place, array in enumerate(inputs)})
        return graph


def _padded(array: Array, sizes: Shape) -> Array:
    """The array with its first axes filled up with zeros to these sizes."""
    shape = sizes + array.shape[len(sizes) :]
    if array.shape == shape:
        return np.ascontiguousarray(array)
    result = np.zeros(shape, dtype=array.dtype)
    result[tuple(map(slice, array.shape))] = array
    return result


def _multiple(count: int, of: int) -> int:
    """The least positive multiple that is not below a count."""
    return max(-(-count // of), 1) * of


def _power_of_two(count: int) -> int:
    return 1 << (count - 1).bit_length()
