"""The record of a batch of flights, and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flockopt.batches import journal
from flockopt.errors import SettingsError
from flockopt.records import files
from sim.trials.trial import COLUMNS, TIMINGS, Result

__all__ = ["Journal"]


class Journal(journal.Journal):
    """Results of flights by key, kept in a folder: see `flockopt.batches.journal.Journal`.

    Args:
        folder: Where; made if it does not exist.
        terms: What all flights of the batch share.

    Raises:
        SettingsError: If the folder cannot be used, is in use, or holds another batch.
    """

    def __init__(self, folder: Path, terms: dict[str, Any]) -> None:
        super().__init__(folder, terms, "flights", ("row", "timing"))

    @property
    def results(self) -> Mapping[str, Result]:
        """All results."""
        return {key: Result(key, **self[key]) for key in self}

    def add(self, result: Result) -> None:
        """Append a result; one that is there already changes nothing."""
        self.append(result.key, {"row": dict(result.row), "timing": dict(result.timing)})

    def write_tables(self, keys: Sequence[str]) -> None:
        """Write ``flights.csv`` and ``timings.csv``: the flights of these keys, in their order, whole or not at all."""
        chosen = [self[key] for key in keys if key in self]
        for name, columns, field in (("flights.csv", COLUMNS, "row"), ("timings.csv", TIMINGS, "timing")):
            text = journal.table(columns, [record[field] for record in chosen])
            files.write_whole(SettingsError, self.folder / name, text)
