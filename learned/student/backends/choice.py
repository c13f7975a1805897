"""What computes the student, and what a plan can say of it: the backend's name, and which weights these are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.networks.shipped import load_once
from learned.networks.weight_files import file_digest
from learned.student.backends.graphs import TracedStudent
from learned.student.backends.openvino import PRECISIONS, OpenVinoStudent
from learned.student.inference import Network
from learned.student.network.model import Student

__all__ = ["BACKENDS", "Loaded", "loaded", "network"]

TORCH, EAGER, OPENVINO = "torch", "torch-eager", "openvino-"

#: ``torch`` traces the network once a process, ``torch-eager`` runs the modules as they are. The first one computes unless
#: another is asked for, whatever else is installed: another backend rounds otherwise, and could lead to another plan.
BACKENDS = (TORCH, EAGER, *(OPENVINO + precision for precision in PRECISIONS))


@dataclass(frozen=True, eq=False)
class Loaded:
    """A student ready to be asked, and what it is.

    Attributes:
        network: What is asked.
        backend: The one of `BACKENDS` that computes it.
        digest: SHA-256 of its weight file.
    """

    network: Network
    backend: str
    digest: str


def loaded(student: Student, path: Path, backend: str | None = None) -> Loaded:
    """A student as a backend computes it.

    Args:
        student: With the weights of the file.
        path: The file.
        backend: One of `BACKENDS`; None takes the first, and runs a student that draws whole fleets as it is.

    Raises:
        SettingsError: If there is no backend of this name, or it cannot compute this student.
        MissingExtra: If what the backend needs is not installed.
    """
    usual = TORCH if student.draws_rows else EAGER
    name = usual if backend is None else checks.choice(SettingsError, "backend", backend, known=BACKENDS)
    return Loaded(network(student, name), name, load_once(file_digest, path))


@lru_cache(maxsize=8)
def network(student: Student, backend: str) -> Network:
    """A student as one of `BACKENDS` computes it, its weights as they are now.

    Raises:
        SettingsError: If the backend cannot compute this student.
        MissingExtra: If what the backend needs is not installed.
    """
    if backend.startswith(OPENVINO):
        return OpenVinoStudent(student, backend.removeprefix(OPENVINO))
    return TracedStudent(student) if backend == TORCH else student
