"""Progress of long work, on stderr."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Self

__all__ = ["Progress"]

#: Work that ends sooner is not worth a word, seconds.
PATIENCE_S = 1.0
#: How often the line on a terminal is redrawn, seconds.
REDRAW_S = 0.1


class Progress:
    """Call it with a stage and the fraction of the stage that is done; silent in the first second.

    On a terminal one line is redrawn and wiped at the end; elsewhere each stage is one line.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet, self._live = quiet, sys.stderr.isatty()
        self._begun = time.monotonic()
        self._drawn_at, self._width, self._stage = 0.0, 0, ""

    def __call__(self, stage: str, fraction: float) -> None:
        """Report that ``fraction`` (0 to 1) of ``stage`` is done."""
        now = time.monotonic()
        elapsed = now - self._begun
        if self._quiet or elapsed < PATIENCE_S:
            return
        if self._live and now - self._drawn_at >= REDRAW_S:
            self._redraw(f"{stage} {fraction:.0%}, {elapsed:.1f} s")
            self._drawn_at = now
        elif not self._live and stage != self._stage:
            print(f"{stage}, {elapsed:.1f} s", file=sys.stderr, flush=True)
        self._stage = stage

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        if self._width:
            self._redraw("")
            print("\r", end="", file=sys.stderr, flush=True)

    def _redraw(self, line: str) -> None:
        print(f"\r{line:<{self._width}}", end="", file=sys.stderr, flush=True)
        self._width = len(line)
