"""What computes the student: torch unless asked otherwise."""

from __future__ import annotations

import os
from functools import lru_cache

from flockopt.errors import SettingsError
from learned.student.backends.graphs import TracedStudent
from learned.student.backends.openvino import PRECISIONS, OpenVinoStudent
from learned.student.inference import Network
from learned.student.network.model import Student

__all__ = ["BACKENDS", "VARIABLE", "chosen_backend", "network"]

#: The environment variable that names what the planners compute with.
VARIABLE = "FLOCKOPT_STUDENT_BACKEND"

OPENVINO = "openvino-"

#: ``torch`` traces the network once a process, ``torch-eager`` runs the modules as they are.
BACKENDS = ("torch", "torch-eager", *(OPENVINO + precision for precision in PRECISIONS))


def chosen_backend() -> str:
    """The backend that the environment names.

    Raises:
        SettingsError: If there is none of this name.
    """
    name = os.environ.get(VARIABLE) or BACKENDS[0]
    if name not in BACKENDS:
        raise SettingsError(VARIABLE, f"is {name!r}", f"must be one of {', '.join(BACKENDS)}", "choose one or unset it")
    return name


@lru_cache(maxsize=8)
def network(student: Student, backend: str) -> Network:
    """A student as one of `BACKENDS` computes it, its weights as they are now.

    With torch, a student that draws whole fleets runs as it is.

    Raises:
        SettingsError: If the backend cannot compute this student.
        MissingExtra: If what the backend needs is not installed.
    """
    if backend.startswith(OPENVINO):
        return OpenVinoStudent(student, backend.removeprefix(OPENVINO))
    if backend == "torch" and student.draws_rows:
        return TracedStudent(student)
    return student
