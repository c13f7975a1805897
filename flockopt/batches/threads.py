"""Long compiled work in slices, by all cores: compiled loops let go of Python (``nogil``), so that threads are enough."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Generic, TypeVar

from numba import config

from flockopt.batches.deadline import NEVER, SLICE_S, Deadline

__all__ = ["spread"]

T = TypeVar("T")

#: Work that ends sooner, seconds, is not worth starting threads for.
SOON_S = 2e-3


def spread(work: Callable[[int, int], T], rounds: int, doing: str, deadline: Deadline = NEVER, first: int = 1) -> list[T]:
    """What ``work(begin, end)`` gives for slices that cover so many rounds, in their order.

    It begins in this thread; where that takes long, the rest is done by as many threads as there are cores for this process,
    `NUMBA_NUM_THREADS` at most. What the parts amount to must not depend on where slices end.

    Args:
        work: Compiled, without Python's lock; called for one slice at a time by each thread.
        rounds: How many there are.
        doing: What `OutOfTime` says.
        deadline: When to give up.
        first: Rounds of the first slice.

    Raises:
        OutOfTime: If the deadline passes.
    """
    parts, begin, began = [], 0, perf_counter()
    for begin, end in deadline.slices(rounds, doing, first):
        parts.append(work(begin, end))
        begin = end
        if perf_counter() - began > SOON_S:
            break
    num_threads = min(rounds - begin, _num_cores()) if threading.current_thread() is threading.main_thread() else 1
    if begin >= rounds or num_threads < 2:
        rest = deadline.slices(rounds - begin, doing, max(begin, 1))
        return parts + [work(begin + start, begin + stop) for start, stop in rest]
    left = _Rest(work, begin, rounds, doing, deadline, max(begin, 1))
    with ThreadPoolExecutor(num_threads) as pool:
        running = [pool.submit(left.do) for _ in range(num_threads)]
        try:
            for future in running:
                future.result()
        finally:
            left.stop()
    return parts + [part for _, part in sorted(left.parts.items())]


class _Rest(Generic[T]):
    """Rounds that several threads take slices of."""

    def __init__(
        self, work: Callable[[int, int], T], begin: int, rounds: int, doing: str, deadline: Deadline, first: int
    ) -> None:
        self.work, self.begin, self.rounds, self.doing, self.deadline, self.first = work, begin, rounds, doing, deadline, first
        self.parts: dict[int, T] = {}
        self.lock = threading.Lock()

    def stop(self) -> None:
        """Let nobody begin another slice."""
        with self.lock:
            self.begin = self.rounds

    def do(self) -> None:
        """Take slices until none is left, each of about `SLICE_S`."""
        size = self.first
        while True:
            self.deadline.check(self.doing)
            with self.lock:
                begin = self.begin
                end = self.begin = min(begin + min(size, max((self.rounds - begin) // 4, 1)), self.rounds)
            if begin >= self.rounds:
                return
            began = perf_counter()
            self.parts[begin] = self.work(begin, end)
            size = max(1, int((end - begin) * min(SLICE_S / max(perf_counter() - began, 1e-9), 4.0)))


def _num_cores() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, int(config.NUMBA_NUM_THREADS))
