"""When work is to end: one object that a plan hands to all of its stages, whose long loops run in slices.

A compiled loop neither sees a clock nor hears an interrupt from the keyboard. So whoever has a long one calls it for a slice of
its rounds at a time (`Deadline.slices`); between two slices Python answers both, deadline or none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

from flockopt.errors import FlockError

__all__ = ["NEVER", "Deadline", "OutOfTime"]

#: How long a slice is to take, seconds: short against a second, long against what a call costs.
SLICE_S = 0.03

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
    def is_never(self) -> bool:
        """Whether there is no limit."""
        return self.at_s == math.inf

    def within(self, share: float) -> Deadline:
        """An earlier one: when this share of what is left has passed."""
        return self if self.is_never else Deadline(perf_counter() + share * max(self.left_s, 0.0))

    def check(self, doing: str) -> None:
        """Raise `OutOfTime` if it is over; ``doing`` goes into the message, such as "finding ways among obstacles"."""
        if not self.is_never and self.left_s < 0.0:
            raise OutOfTime(doing)

    def slices(self, rounds: int, doing: str) -> Iterator[tuple[int, int]]:
        """Begin and end of slices that cover ``rounds`` rounds, so many at a time as `SLICE_S` lets pass.

        What is computed must not depend on where slices end: their sizes differ from run to run.

        Raises:
            OutOfTime: Before a slice that would begin too late.
        """
        begin, size = 0, 1
        while begin < rounds:
            self.check(doing)
            end, began = min(begin + size, rounds), perf_counter()
            yield begin, end
            pace = SLICE_S / max(perf_counter() - began, 1e-9)
            size = max(1, round(min(GROWTH * size, pace * (end - begin))))
            begin = end


#: No limit.
NEVER = Deadline()
