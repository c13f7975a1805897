"""A progress bar on stderr; where stderr is no terminal, a line now and then."""

from __future__ import annotations

import sys
import time

__all__ = ["ProgressBar"]

WIDTH = 24

#: Where stderr is no terminal, a line each time this share of the work is done.
SHARE_A_LINE = 0.1


class ProgressBar:
    """Counts what is done.

    Args:
        total: How much there is to do.
        done: How much of it was done before.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        self._total, self._done, self._before = total, done, done
        self._begun, self._live = time.monotonic(), sys.stderr.isatty()
        self._told = done
        self._draw("")

    def advance(self, words: str) -> None:
        """One more is done; the words say which."""
        self._done += 1
        self._draw(words)

    def note(self, words: str) -> None:
        """A line of its own."""
        print(f"{self._fresh()}{words}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """End the line."""
        if self._live:
            print(file=sys.stderr, flush=True)

    def _draw(self, words: str) -> None:
        share = self._done / self._total if self._total else 1.0
        bar = ("#" * round(WIDTH * share)).ljust(WIDTH, ".")
        text = f"[{bar}] {self._done}/{self._total} {self._left()} {words}".rstrip()
        if self._live:
            print(f"{self._fresh()}{text}", end="", file=sys.stderr, flush=True)
        elif self._done - self._told >= SHARE_A_LINE * self._total or self._done == self._total:
            print(text, file=sys.stderr, flush=True)
            self._told = self._done

    def _left(self) -> str:
        made = self._done - self._before
        if not made or self._done == self._total:
            return ""
        seconds = (time.monotonic() - self._begun) / made * (self._total - self._done)
        return f"{seconds:.0f} s left"

    def _fresh(self) -> str:
        return "\r\x1b[K" if self._live else ""
