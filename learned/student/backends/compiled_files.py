"""Compiled graphs kept on disk, for the next process of the same user.

A file is a checksum and what a compiler exported: a graph with weights, no code. Whatever is missing, damaged or cannot be
written costs compiling anew, never a wrong answer: names hold a digest of the weights, the versions and the sources.
"""

from __future__ import annotations

import hashlib
import os
import platform
from contextlib import suppress
from pathlib import Path

import torch

from flockopt.errors import SettingsError
from flockopt.records import files
from learned.student.network.model import Student

__all__ = ["CompiledFiles", "digest_of", "usual_folder"]

#: The files whose text says what is computed.
SOURCES = (
    "networks/diffusion.py", "networks/transformer.py", "student/network/allocation_head.py",
    "student/network/bundle_encoder.py", "student/network/denoiser.py", "student/network/model.py", "student/network/rows.py",
    "student/network/scene_encoder.py", "student/scenes/batch.py", "student/backends/graphs.py",
    "student/backends/openvino.py",
)  # fmt: skip

#: The package that they are in.
PACKAGE = Path(__file__).resolve().parents[2]

#: Bytes of the checksum that a file begins with.
CHECKSUM_BYTES = hashlib.sha256().digest_size


def usual_folder() -> Path:
    """``flockopt/student`` in the user's caches: ``$XDG_CACHE_HOME``, or ``~/.cache``."""
    caches = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(caches) if caches else Path.home() / ".cache") / "flockopt" / "student"


def digest_of(student: Student, *versions: str) -> str:
    """Of all that a compiled graph depends on but its input sizes: weights, settings, sources, versions and machine."""
    digest = hashlib.sha256(repr((student.settings, torch.__version__, platform.machine(), *versions)).encode())
    for name, tensor in sorted(student.state_dict().items()):
        digest.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    for module in SOURCES:
        digest.update((PACKAGE / module).read_bytes())
    return digest.hexdigest()


class CompiledFiles:
    """A folder of compiled graphs of one student.

    Args:
        folder: Made when something is written, for its user alone; None for `usual_folder`.
        digest: From `digest_of`.
    """

    def __init__(self, folder: Path | None, digest: str) -> None:
        self._folder, self._digest = folder or usual_folder(), digest

    def read(self, name: str) -> bytes | None:
        """What was written under this name, or None where there is nothing whole."""
        try:
            content = self._path(name).read_bytes()
        except OSError:
            return None
        checksum, graph = content[:CHECKSUM_BYTES], content[CHECKSUM_BYTES:]
        return graph if hashlib.sha256(graph).digest() == checksum else None

    def write(self, name: str, graph: bytes) -> None:
        """Keep a graph, whole or not at all."""
        with suppress(OSError, SettingsError):  # a full or read-only disk is no reason not to plan
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            files.write_whole(SettingsError, self._path(name), hashlib.sha256(graph).digest() + graph)

    def _path(self, name: str) -> Path:
        return self._folder / (hashlib.sha256(f"{self._digest} {name}".encode()).hexdigest()[:40] + ".graph")
