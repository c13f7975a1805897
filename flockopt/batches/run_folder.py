"""A folder that one run at a time writes to, and that only a run on the same terms may continue."""

from __future__ import annotations

import fcntl
import json
import os
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flockopt.errors import SettingsError
from flockopt.records import checks, files

__all__ = ["TERMS", "RunFolder"]

TERMS, LOCK = "terms.json", ".lock"


class RunFolder:
    """The folder of a long run, locked while it is open; to be used in a ``with`` statement.

    Args:
        folder: Where; made if it does not exist.
        terms: What all parts of the run share. A folder that holds a run on other terms is refused.
        content: What the folder holds, in words for errors.

    Raises:
        SettingsError: If the folder cannot be used, is in use, or holds another run.
    """

    def __init__(self, folder: Path, terms: dict[str, Any], content: str) -> None:
        self.folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as fault:
            value = f"{folder} cannot be used ({fault.strerror})"
            raise SettingsError("out", value, "must be a folder to write to", "choose another") from None
        with ExitStack() as unless_agreed:
            unless_agreed.callback(self.close)
            self._claim()
            self._agree(json.loads(json.dumps(terms)), content)
            unless_agreed.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Let others use the folder."""
        os.close(self._lock)

    def _claim(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            mend = "wait for it or choose another folder"
            raise SettingsError("out", f"{self.folder} is in use", "one run at a time writes there", mend) from None

    def _agree(self, terms: dict[str, Any], content: str) -> None:
        path = self.folder / TERMS
        if not path.exists():
            files.write_whole(SettingsError, path, json.dumps(terms, indent=1) + "\n")
            return
        found = files.read_json(SettingsError, path)
        for name, value in terms.items():
            if not isinstance(found, dict) or found.get(name) != value:
                shown = checks.shown(found.get(name) if isinstance(found, dict) else found)
                seen = f"{self.folder} holds {content} with {name} {shown}"
                raise SettingsError("out", seen, f"this run has {checks.shown(value)}", "choose another folder")
