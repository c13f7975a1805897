"""What a training run needs to go on exactly where it stopped: weights, their average, and the optimiser's moments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from flockopt.errors import SettingsError
from learned.student.model import Student
from learned.student.settings import StudentSettings
from learned.weight_files import load_weights, save_weights, to_bytes, to_floats

__all__ = [
    "CHECKPOINT_KIND",
    "KIND",
    "STORAGES",
    "fill",
    "in_bfloat16",
    "load_student",
    "restore",
    "save_checkpoint",
    "save_student",
]

#: The kinds of weight files.
KIND, CHECKPOINT_KIND = "student", "student-checkpoint"

#: How weights for inference are stored: the second takes half the room, for matrices that are off by 1/254 at most.
STORAGES = ("bfloat16", "int8")

MEND = "take the file of a run with these settings, or start anew in another folder"


def save_student(
    path: str | Path, weights: dict[str, Tensor], settings: StudentSettings, notes: dict[str, Any], storage: str = STORAGES[0]
) -> None:
    """Write weights for inference; ``notes`` say how they came about, ``storage`` is one of `STORAGES`."""
    stored = to_bytes(weights) if storage == "int8" else in_bfloat16(weights)
    save_weights(path, stored, KIND, {"student": settings.to_dict(), "notes": notes})


def load_student(path: str | Path) -> Student:
    """A student in evaluation mode from a file of `save_student`.

    Raises:
        SettingsError: If the file is missing, damaged, foreign, or its weights do not fit its settings.
        MissingExtra: If torch or safetensors is not installed.
    """
    tensors, header = load_weights(path, KIND)
    student = Student(StudentSettings.from_dict(header.get("student", {})))
    fill(student, to_floats(tensors), path)
    return student.eval()


def in_bfloat16(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights as they are stored for inference; the spread of samples stays exact."""
    return {name: value.to(torch.bfloat16) if name != "spread" else value for name, value in weights.items()}


def fill(student: nn.Module, tensors: dict[str, Tensor], path: str | Path) -> None:
    """Give a network its weights.

    Raises:
        SettingsError: If they do not fit, naming the file they are from.
    """
    try:
        student.load_state_dict(tensors)
    except RuntimeError as fault:
        words = str(fault).splitlines()[-1].strip()
        raise SettingsError(
            "weights", f"{path} does not fit ({words})", "names and shapes must be the network's", MEND
        ) from None


def save_checkpoint(
    path: Path, student: nn.Module, average: dict[str, Tensor], optimiser: torch.optim.Optimizer, header: dict[str, Any]
) -> None:
    """Write everything that changes in training; ``header`` holds the settings and the step."""
    tensors = {f"model/{name}": value for name, value in student.state_dict().items()}
    tensors |= {f"average/{name}": value for name, value in average.items()}
    for index, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser/{index}/{name}": torch.as_tensor(value) for name, value in moments.items()}
    # clones: tensors that share memory cannot stand in one safetensors file
    save_weights(path, {name: value.clone() for name, value in tensors.items()}, CHECKPOINT_KIND, header)


def restore(
    path: Path, student: nn.Module, average: dict[str, Tensor], optimiser: torch.optim.Optimizer, settings: dict[str, Any]
) -> int:
    """Fill student, average and optimiser from a checkpoint of a run on the same ``settings``; its step.

    Raises:
        SettingsError: If the file is not a checkpoint of such a run.
    """
    tensors, header = load_weights(path, CHECKPOINT_KIND)
    if header.get("training") != settings:
        raise SettingsError("out", f"holds a run on other settings ({path})", "a run goes on with its own settings", MEND)
    groups: dict[str, dict[str, Tensor]] = {"model": {}, "average": {}, "optimiser": {}}
    for name, value in tensors.items():
        group, _, rest = name.partition("/")
        groups[group][rest] = value
    fill(student, groups["model"], path)
    for name, value in groups["average"].items():
        average[name].copy_(value)
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in groups["optimiser"].items():
        index, _, moment = name.partition("/")
        state.setdefault(int(index), {})[moment] = value
    optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
    return int(header["step"])
