"""Progress on stderr: a bar for counted work, a line for stages; where stderr is no terminal, a line now and then."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from types import TracebackType
from typing import Self

__all__ = ["ProgressBar", "StageLine"]

WIDTH = 24

#: Work that ends sooner is not worth a word, seconds.
PATIENCE_S = 1.0

#: How often the line on a terminal is redrawn, seconds.
REDRAW_S = 0.1

#: Where stderr is no terminal, a line each time this share of the work is done.
SHARE_A_LINE = 0.1


def _say(words: str, end: str = "\n") -> None:
    """Words for stderr; where that is closed or full, nobody is told, and the work goes on."""
    with suppress(OSError, ValueError):
        if sys.stderr is not None:
            print(words, end=end, file=sys.stderr, flush=True)


def _is_terminal() -> bool:
    return sys.stderr is not None and not sys.stderr.closed and sys.stderr.isatty()


class ProgressBar:
    """Counts what is done.

    Args:
        total: How much there is to do; None where nobody knows.
        done: How much of it was done before.
    """

    def __init__(self, total: int | None, done: int = 0) -> None:
        self._total, self._done, self._before = total, done, done
        self._begun, self._live = time.monotonic(), _is_terminal()
        self._told = done
        self._draw("")

    def advance(self, words: str, *, is_new: bool = True) -> None:
        """One more is done, or turns out to have been done before; the words say which."""
        self._done += 1
        self._before += not is_new
        self._draw(words)

    def note(self, words: str) -> None:
        """A line of its own."""
        _say(f"{self._fresh()}{words}")

    def close(self) -> None:
        """End the line."""
        if self._live:
            _say("")

    def _draw(self, words: str) -> None:
        text = f"{self._so_far()} {self._left()} {words}".rstrip()
        if self._live:
            _say(f"{self._fresh()}{text}", end="")
        elif self._done - self._told >= self._step() or self._done == self._total:
            _say(text)
            self._told = self._done

    def _so_far(self) -> str:
        if self._total is None:
            return f"{self._done} done"
        share = self._done / self._total if self._total else 1.0
        return f"[{('#' * round(WIDTH * share)).ljust(WIDTH, '.')}] {self._done}/{self._total}"

    def _step(self) -> float:
        """After how many more a line is due where stderr is no terminal."""
        return max(self._told, 1) if self._total is None else SHARE_A_LINE * self._total

    def _left(self) -> str:
        made = self._done - self._before
        if not made or self._total is None or self._done == self._total:
            return ""
        seconds = (time.monotonic() - self._begun) / made * (self._total - self._done)
        return f"{seconds:.0f} s left"

    def _fresh(self) -> str:
        return "\r\x1b[K" if self._live else ""


class StageLine:
    """Call it with a stage and the fraction of the stage that is done; silent in the first second.

    On a terminal one line is redrawn and wiped at the end; elsewhere each stage is one line.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet, self._live = quiet, _is_terminal()
        self._begun = time.monotonic()
        self._drawn_at, self._width, self._stage, self._told = 0.0, 0, "", 0.0

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
            _say(f"{stage}, {elapsed:.1f} s")
        self._stage = stage

    def tell(self, words: str, fraction: float) -> None:
        """Report that ``fraction`` (0 to 1) of something in the middle of a stage is done; a line of its own now and then."""
        now = time.monotonic()
        elapsed = now - self._begun
        if self._quiet or elapsed < PATIENCE_S:
            return
        if self._live and now - self._drawn_at >= REDRAW_S:
            self._redraw(f"{words}, {elapsed:.1f} s")
            self._drawn_at = now
        elif not self._live and fraction - self._told >= SHARE_A_LINE:
            _say(f"{words}, {elapsed:.1f} s")
            self._told = fraction

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        if self._width:
            self._redraw("")
            _say("\r", end="")

    def _redraw(self, line: str) -> None:
        _say(f"\r{line:<{self._width}}", end="")
        self._width = len(line)
