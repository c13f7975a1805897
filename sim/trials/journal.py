"""The record of a batch of flights, and its tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flockopt.batches import journal
from flockopt.errors import SettingsError
from flockopt.records import files
from sim.trials.trial import COLUMNS, TIMINGS, Result, Value

__all__ = ["Journal", "table"]


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
        self._lines = journal.Journal(folder, terms, "flights", ("row", "timing"))
        self.results = {key: Result(key, record["row"], record["timing"]) for key, record in self._lines.records.items()}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self._lines.__exit__(kind, fault, trace)

    def __contains__(self, key: str) -> bool:
        return key in self.results

    def add(self, result: Result) -> None:
        """Append a result, through to the disk; one that is there already changes nothing."""
        self._lines.add(result.key, {"row": dict(result.row), "timing": dict(result.timing)})
        self.results.setdefault(result.key, result)

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
