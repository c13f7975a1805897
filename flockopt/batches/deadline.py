"""When work is to end: one object that a plan hands to all of its stages, whose long loops run in slices.

A compiled loop neither sees a clock nor hears an interrupt from the keyboard. So whoever has a long one calls it for a slice of
its rounds at a time (`Deadline.slices`); between two slices Python answers both, deadline or none.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from dataclasses import dataclass
from time import perf_counter
from typing import TypeVar

from flockopt.errors import FlockError

__all__ = ["HEARD", "NEVER", "SLICE_S", "Deadline", "OutOfTime", "heard", "is_still_at_work"]

T = TypeVar("T")

#: How long a slice is to take, seconds: short against a second, long against what a call costs.
SLICE_S = 0.03

#: The name of the threads in which `heard` has work done.
HEARD = "flockopt heard"

#: A slice has at most so many times the rounds of the one before it.
GROWTH = 4


class OutOfTime(FlockError):
    """A deadline has passed; the message says while doing what. Whoever set the deadline catches it."""

    def __init__(self, doing: str) -> None:
        self.doing = doing
        super().__init__(f"out of time while {doing}")


@dataclass(frozen=True)
class Deadline:
    """A moment by which to be done.

    Attributes:
        at_s: On the clock of `time.perf_counter`; infinite for never.
    """

    at_s: float = math.inf

    @classmethod
    def after(cls, seconds: float | None) -> Deadline:
        """The moment so many seconds from now; None for never."""
        return cls() if seconds is None else cls(perf_counter() + seconds)

    @property
    def left_s(self) -> float:
        """Seconds left, infinite without a limit, negative when it is over."""
        return self.at_s - perf_counter()

    @property
    def is_over(self) -> bool:
        """Whether it has passed."""
        return not self.is_never and self.left_s < 0.0

    @property
    def is_never(self) -> bool:
        """Whether there is no limit."""
        return self.at_s == math.inf

    def within(self, share: float) -> Deadline:
        """An earlier one: when this share of what is left has passed."""
        return self if self.is_never else Deadline(perf_counter() + share * max(self.left_s, 0.0))

    def check(self, doing: str) -> None:
        """Raise `OutOfTime` if it is over; ``doing`` goes into the message, such as "finding ways among obstacles"."""
        if self.is_over:
            raise OutOfTime(doing)

    def slices(self, rounds: int, doing: str, first: int = 1) -> Iterator[tuple[int, int]]:
        """Begin and end of slices that cover ``rounds`` rounds, ``first`` at first, then so many as `SLICE_S` lets pass.

        What is computed must not depend on where slices end: their sizes differ from run to run.

        Raises:
            OutOfTime: Before a slice that would begin too late.
        """
        begin, size = 0, first
        while begin < rounds:
            self.check(doing)
            end, began = min(begin + size, rounds), perf_counter()
            yield begin, end
            pace = SLICE_S / max(perf_counter() - began, 1e-9)
            size = max(1, round(min(GROWTH * size, pace * (end - begin))))
            begin = end


#: No limit.
NEVER = Deadline()


def heard(
    work: Callable[[], T], stop: Callable[[], None] | None = None, *, deadline: Deadline = NEVER, doing: str = "computing"
) -> T:
    """What ``work`` returns or raises, done in a thread of its own, so that an interrupt is heard meanwhile.

    For solvers, which keep their own time, and for compiled loops (``nogil``) of bounded work; both let other threads run.

    Args:
        work: Called once.
        stop: Called to end the work early; without it the thread is left to end by itself.
        deadline: When to stop waiting.
        doing: What `OutOfTime` says then.

    Raises:
        OutOfTime: If the deadline passes before the work is done.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()  # only the main thread hears the keyboard
    answer: Future[T] = Future()

    def run() -> None:
        try:
            answer.set_result(work())
        except BaseException as fault:  # the caller gets it, whatever it is
            answer.set_exception(fault)

    threading.Thread(target=run, name=HEARD, daemon=True).start()
    done = False
    try:
        wait([answer], None if deadline.is_never else max(deadline.left_s, 0.0))
        done = answer.done()
    finally:
        if not done and stop is not None:
            stop()
    if not done:
        raise OutOfTime(doing)
    return answer.result()


def is_still_at_work() -> bool:
    """Whether some work of `heard` goes on after an interrupt, so that the process cannot end in good order."""
    return any(thread.name == HEARD for thread in threading.enumerate())
