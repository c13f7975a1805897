"""Students in files, for inference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from learned.networks.checkpoint import in_bfloat16, load_network
from learned.networks.weight_files import save_weights, to_bytes
from learned.student.network.model import Student
from learned.student.settings import StudentSettings

__all__ = ["KIND", "STORAGES", "load_student", "save_student"]

#: The kind of weight file that a student is.
KIND = "student"

#: How weights for inference are stored: the second takes half the room, for matrices that are off by 1/254 at most.
STORAGES = ("bfloat16", "int8")


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
    return load_network(path, KIND, "student", StudentSettings.from_dict, Student)
