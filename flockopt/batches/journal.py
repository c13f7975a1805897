"""The record of a long run: a line an entry, appended whole, so that a run that was killed goes on where it stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flockopt.batches.run_folder import RunFolder
from flockopt.errors import SettingsError
from flockopt.records import checks, files

__all__ = ["ROWS", "Journal"]

ROWS = "rows.jsonl"


class Journal:
    """Records by key, kept in a folder that one run at a time may write to; to be used in a ``with`` statement.

    Args:
        folder: Where; made if it does not exist.
        terms: What all entries of the run share. A folder that holds a run on other terms is refused.
        content: What the folder holds, in words for errors.
        fields: What every record has beside its key.

    Raises:
        SettingsError: If the folder cannot be used, is in use, or holds another run.
    """

    def __init__(self, folder: Path, terms: dict[str, Any], content: str, fields: Sequence[str]) -> None:
        self.folder, self._fields = folder, ("key", *fields)
        self.records: dict[str, dict[str, Any]] = {}
        self._run = RunFolder(folder, terms, content)
        with ExitStack() as unless_opened:
            unless_opened.callback(self._run.close)
            self._read()
            self._file = os.open(folder / ROWS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            unless_opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        os.close(self._file)
        self._run.close()

    def __contains__(self, key: str) -> bool:
        return key in self.records

    def add(self, key: str, record: dict[str, Any]) -> None:
        """Append a record, through to the disk; one that is there already changes nothing."""
        if key in self.records:
            return
        os.write(self._file, json.dumps({"key": key} | record).encode() + b"\n")
        os.fsync(self._file)
        self.records[key] = record

    def _read(self) -> None:
        """Read the lines that are whole; what a kill left of the last one is cut off."""
        path = self.folder / ROWS
        content = path.read_bytes() if path.exists() else b""
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            os.truncate(path, len(whole))
        for number, line in enumerate(whole.decode().splitlines(), start=1):
            record = files.parse_json(SettingsError, line, f"{path} line {number}")
            fields = checks.keys(SettingsError, record, self._fields)
            key = fields.pop("key")
            self.records.setdefault(key, fields)
