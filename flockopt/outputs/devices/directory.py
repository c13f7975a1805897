"""Directories written whole or not at all, and overwritten only where nobody else's work is lost."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flockopt.errors import SettingsError

__all__ = ["MANIFEST", "check_directory", "write_directory"]

#: Lists what was written, with digests, so that it can be told from what people put there or changed.
MANIFEST = "flockopt-export.json"

FORMAT = "flockopt.export/1"


def check_directory(path: str | Path) -> Path:
    """The real path of an output directory, once nothing stands in the way of writing it.

    Raises:
        SettingsError: If it is no directory, cannot be written, or holds anything but an untouched earlier export.
    """
    target = Path(os.path.realpath(path))
    try:
        if target.exists() and not target.is_dir():
            raise SettingsError("", f"{path} is not a directory", "the output must be a directory", "choose another path")
        if target.exists() and not _is_replaceable(target):
            rule = "only an empty directory or an untouched export is overwritten"
            raise SettingsError(
                "", f"{path} holds other files, or files changed since", rule, "choose another path or empty it"
            )
        with tempfile.TemporaryFile(dir=target.parent):
            return target
    except OSError as fault:
        raise _unwritable(path, fault) from None


def write_directory(path: str | Path, files: Mapping[str, str], origin: Mapping[str, Any]) -> None:
    """Write a directory: into a temporary neighbour first, which then takes its place.

    Args:
        path: The directory, which is made or replaced (see `check_directory`).
        files: Contents by name.
        origin: What the manifest says of where they come from.
    """
    target = check_directory(path)
    encoded = {name: content.encode("utf-8") for name, content in files.items()}
    listed = {name: hashlib.sha256(content).hexdigest() for name, content in sorted(encoded.items())}
    manifest = json.dumps({"format": FORMAT, **origin, "files": listed}, indent=1) + "\n"
    workplace = None
    try:
        workplace = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name[:40]}."))
        fresh = workplace / "new"
        fresh.mkdir()
        for name, content in {**encoded, MANIFEST: manifest.encode("utf-8")}.items():
            (fresh / name).write_bytes(content)
        _swap(fresh, target, workplace / "old")
    except OSError as fault:
        raise _unwritable(path, fault) from None
    finally:
        if workplace is not None:
            shutil.rmtree(workplace, ignore_errors=True)


def _swap(fresh: Path, target: Path, aside: Path) -> None:
    if not target.exists():
        os.replace(fresh, target)
        return
    os.replace(target, aside)
    try:
        os.replace(fresh, target)
    except OSError:
        os.replace(aside, target)
        raise


def _is_replaceable(target: Path) -> bool:
    """Whether a directory is empty, or holds exactly what its manifest says was written there."""
    names = {entry.name for entry in target.iterdir()}
    if not names:
        return True
    try:
        manifest = json.loads((target / MANIFEST).read_text(encoding="utf-8"))
        listed = manifest["files"] if manifest["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False
    if not isinstance(listed, dict) or names != {*listed, MANIFEST}:
        return False
    return all(
        (target / name).is_file() and hashlib.sha256((target / name).read_bytes()).hexdigest() == digest
        for name, digest in listed.items()
    )


def _unwritable(path: str | Path, fault: OSError) -> SettingsError:
    rule = "the output must be a directory that can be written"
    return SettingsError("", f"{path} cannot be written ({fault.strerror})", rule, "choose another path")
