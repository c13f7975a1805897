"""What every benchmark shares: rows that survive a kill, a table in Markdown, and the machine it ran on."""

from __future__ import annotations

import argparse
import csv
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from flockopt.records.arrays import FloatArray

__all__ = [
    "CsvRows",
    "Record",
    "benchmark_parser",
    "header",
    "markdown_table",
    "peak_memory_gb",
    "spread",
    "tell",
    "write_summary",
]


#: A row of a table, by column.
Record: TypeAlias = dict[str, Any]


class CsvRows:
    """A CSV file that holds every row as soon as it is known.

    Args:
        path: The file; replaced if it exists.
        columns: Its columns, in order.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.records: list[Record] = []
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, fieldnames=list(columns), lineterminator="\n")
        self._writer.writeheader()

    def add(self, record: Record) -> None:
        """Write one row through to the disk."""
        self.records.append(record)
        self._writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in record.items()})
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def benchmark_parser(name: str, doc: str | None) -> argparse.ArgumentParser:
    """A command line with what every benchmark is told: its first seed, and where results go."""
    module = f"benchmarks.{name}"
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=(doc or "").split("\n")[0])
    parser.add_argument("--seed", type=int, default=0, help="the first one; the others follow (default 0)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    return parser


def tell(words: str) -> None:
    """How far a benchmark is, on one line of stderr that the next words replace; a newline ends it."""
    print(words if words == "\n" else f"\r{words}", end="", file=sys.stderr, flush=True)


def header(title: str, module: str) -> str:
    """A Markdown heading with the command, the commit and the machine."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    command = " ".join(["python -m", module, *sys.argv[1:]])
    versions = f"Python {platform.python_version()}, numpy {np.__version__}"
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"
    return f"# {title}\n\n`{command}`\n\nCommit {commit or 'unknown'}; {machine}; {versions}.\n"


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; floats with four significant digits."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        cells = [f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def spread(values: Sequence[float] | FloatArray) -> tuple[float, float]:
    """Median and 95th percentile; NaN for no values."""
    if not len(values):
        return float("nan"), float("nan")
    return float(np.median(values)), float(np.quantile(values, 0.95))


def peak_memory_gb() -> float:
    """The most memory this process and its finished children have held, gigabytes."""
    scale = 1e9 if platform.system() == "Darwin" else 1e6
    return max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / scale


def write_summary(folder: Path, content: str) -> None:
    """Write ``summary.md`` and print it."""
    (folder / "summary.md").write_text(content, encoding="utf-8")
    print(content)
