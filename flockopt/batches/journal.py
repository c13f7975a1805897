"""The record of a batch: a line of JSON an item, appended whole, so that a run that was killed goes on where it stopped."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flockopt.batches.run_folder import RunFolder
from flockopt.errors import SettingsError
from flockopt.records import checks, files

__all__ = ["ROWS", "Journal", "table"]

ROWS = "rows.jsonl"


class Journal:
    """Records by key, kept in a folder that one run at a time may write to; to be used in a ``with`` statement.

    Only their keys are held in memory.

    Args:
        folder: Where; made if it does not exist.
        terms: What all items of the batch share. A folder that holds items on other terms is refused.
        content: What the items are, in words for errors.
        fields: The keys that every record has.
        stands: Whether a record that was found is let stand; what it was made of is to be done again else.

    Raises:
        SettingsError: If the folder cannot be used, is in use, or holds another batch.
    """

    def __init__(
        self,
        folder: Path,
        terms: dict[str, Any],
        content: str,
        fields: Sequence[str],
        stands: Callable[[Mapping[str, Any]], bool] = lambda record: True,
    ) -> None:
        self.folder = folder
        self._fields, self._places, self._size = fields, dict[str, int](), 0
        self._run = RunFolder(folder, terms, content)
        with ExitStack() as unless_opened:
            unless_opened.callback(self._run.close)
            self._file = os.open(folder / ROWS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            unless_opened.callback(os.close, self._file)
            self._read(stands)
            self._lines = unless_opened.enter_context((folder / ROWS).open("rb"))  # only now: it may hold what was cut off
            unless_opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self._lines.close()
        os.close(self._file)
        self._run.close()

    def __contains__(self, key: str) -> bool:
        return key in self._places

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[str]:
        """The keys, in the order in which their records came."""
        return iter(self._places)

    def __getitem__(self, key: str) -> dict[str, Any]:
        """The record of a key, as it stands on the disk."""
        self._lines.seek(self._places[key])
        return self._parsed(self._lines.readline(), key)[1]

    def append(self, key: str, record: Mapping[str, Any]) -> None:
        """Append a record, through to the disk; one that is there already changes nothing."""
        if key in self._places:
            return
        line = json.dumps({"key": key, **record}).encode() + b"\n"
        os.write(self._file, line)
        os.fsync(self._file)
        self._places[key] = self._size
        self._size += len(line)

    def _read(self, stands: Callable[[Mapping[str, Any]], bool]) -> None:
        """Read the lines that are whole; what a kill left of the last one is cut off. Of one key the last line counts."""
        with (self.folder / ROWS).open("rb") as lines:
            for number, line in enumerate(lines, start=1):
                if not line.endswith(b"\n"):
                    os.truncate(self.folder / ROWS, self._size)
                    break
                key, record = self._parsed(line, f"line {number}")
                self._places.pop(key, None)
                if stands(record):
                    self._places[key] = self._size
                self._size += len(line)

    def _parsed(self, line: bytes, where: str) -> tuple[str, dict[str, Any]]:
        source = f"{self.folder / ROWS} {where}"
        record = files.parse_json(SettingsError, line.decode("utf-8", "replace"), source)
        try:
            record = dict(checks.keys(SettingsError, record, ("key", *self._fields)))
            return checks.text(SettingsError, "key", record.pop("key")), record
        except SettingsError as fault:
            raise fault.within(source) from None


def table(columns: Sequence[str], records: Iterable[Mapping[str, Any]]) -> str:
    """CSV text; numbers with nine significant digits, what is not known left empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for record in records:
        writer.writerow([_cell(record.get(column)) for column in columns])
    return text.getvalue()


def _cell(value: str | int | float | None) -> str:
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)
