"""Slices by several threads: all rounds once, in order, and what goes wrong is told."""

from __future__ import annotations

import threading
import time

import pytest

from flockopt.batches import threads
from flockopt.batches.deadline import Deadline, OutOfTime
from flockopt.batches.threads import spread


@pytest.mark.parametrize("rounds", [0, 1, 7, 500])
@pytest.mark.parametrize("pause_s", [0.0, 2e-4])
def test_all_rounds_are_done_once_and_come_in_order(rounds, pause_s, monkeypatch):
    monkeypatch.setattr(threads, "_num_cores", lambda: 3)

    def work(begin, end):
        time.sleep(pause_s * (end - begin))
        return list(range(begin, end))

    assert [entry for part in spread(work, rounds, "counting") for entry in part] == list(range(rounds))


def test_long_work_is_done_by_several_threads(monkeypatch):
    monkeypatch.setattr(threads, "_num_cores", lambda: 2)
    both = threading.Barrier(2, timeout=30)

    def work(begin, end):
        if begin == 0:
            time.sleep(2 * threads.SOON_S)  # long enough to be worth it
        elif not both.broken and begin < 3:
            both.wait()  # goes on only if another thread is here, too
        return threading.get_ident()

    assert len(set(spread(work, 40, "meeting"))) >= 3


def test_elsewhere_than_in_the_main_thread_no_threads_are_started(monkeypatch):
    monkeypatch.setattr(threads, "_num_cores", lambda: 4)
    seen = []

    def run():
        seen.append(set(spread(lambda begin, end: time.sleep(1e-3) or threading.get_ident(), 20, "counting")))

    one = threading.Thread(target=run)
    one.start()
    one.join()
    assert len(seen[0]) == 1


def test_faults_and_deadlines_end_it(monkeypatch):
    monkeypatch.setattr(threads, "_num_cores", lambda: 2)

    def fails(begin, end):
        time.sleep(2e-3)
        if begin > 3:
            raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        spread(fails, 1000, "failing")
    with pytest.raises(OutOfTime, match="out of time while waiting"):
        spread(lambda begin, end: time.sleep(1e-3 * (end - begin)), 10_000, "waiting", Deadline.after(0.05))
