"""The record of a batch: a line a flight, appended whole, so that a run that was killed goes on where it stopped."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flockopt.batches.run_folder import RunFolder
from flockopt.errors import SettingsError
from flockopt.records import checks, files
from sim.trials.trial import COLUMNS, TIMINGS, Result, Value

__all__ = ["Journal", "table"]

ROWS = "rows.jsonl"


class Journal:
    """Results by key, kept in a folder that one run at a time may write to; to be used in a ``with`` statement.

    Args:
        folder: Where; made if it does not exist.
        terms: What all flights of the batch share. A folder that holds flights on other terms is refused.

    Raises:
        SettingsError: If the folder cannot be used, is in use, or holds another batch.
    """

    def __init__(self, folder: Path, terms: dict[str, Any]) -> None:
        self.folder = folder
        self.results: dict[str, Result] = {}
        self._run = RunFolder(folder, terms, "flights")
        with ExitStack() as unless_opened:
            unless_opened.callback(self._run.close)
            self._read()
            self._file = os.open(self.folder / ROWS, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            unless_opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        os.close(self._file)
        self._run.close()

    def __contains__(self, key: str) -> bool:
        return key in self.results

    def add(self, result: Result) -> None:
        """Append a result, through to the disk; one that is there already changes nothing."""
        if result.key in self.results:
            return
        line = json.dumps({"key": result.key, "row": dict(result.row), "timing": dict(result.timing)})
        os.write(self._file, line.encode() + b"\n")
        os.fsync(self._file)
        self.results[result.key] = result

    def _read(self) -> None:
        """Read the lines that are whole; what a kill left of the last one is cut off."""
        path = self.folder / ROWS
        content = path.read_bytes() if path.exists() else b""
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            os.truncate(path, len(whole))
        for number, line in enumerate(whole.decode().splitlines(), start=1):
            record = files.parse_json(SettingsError, line, f"{path} line {number}")
            fields = checks.keys(SettingsError, record, ("key", "row", "timing"))
            self.results.setdefault(fields["key"], Result(fields["key"], fields["row"], fields["timing"]))

    def write_tables(self, keys: Sequence[str]) -> None:
        """Write ``flights.csv`` and ``timings.csv``: the flights of these keys, in their order, whole or not at all."""
        chosen = [self.results[key] for key in keys if key in self.results]
        for name, columns, records in (
            ("flights.csv", COLUMNS, [result.row for result in chosen]),
            ("timings.csv", TIMINGS, [result.timing for result in chosen]),
        ):
            files.write_whole(SettingsError, self.folder / name, table(columns, records))


def table(columns: Sequence[str], records: Iterable[Any]) -> str:
    """CSV text; numbers with nine significant digits, what is not known left empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for record in records:
        writer.writerow([_cell(record.get(column)) for column in columns])
    return text.getvalue()


def _cell(value: Value) -> str:
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)
