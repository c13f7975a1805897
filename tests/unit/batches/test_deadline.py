"""Deadlines: what is left, earlier ones within them, and loops in slices."""

import math

import pytest

from flockopt.batches import deadline
from flockopt.batches.deadline import NEVER, SLICE_S, Deadline, OutOfTime


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is told to go on."""

    class Clock:
        now_s = 100.0

        def pass_s(self, seconds):
            self.now_s += seconds

    clock = Clock()
    monkeypatch.setattr(deadline, "perf_counter", lambda: clock.now_s)
    return clock


def test_slices_cover_all_rounds_in_order(clock):
    slices = list(NEVER.slices(1000, "counting"))
    assert [k for begin, end in slices for k in range(begin, end)] == list(range(1000))
    assert len(slices) < 10  # rounds that cost nothing are taken many at a time


def test_slices_take_as_many_rounds_as_their_time_lets_pass(clock):
    sizes = []
    for begin, end in NEVER.slices(60, "counting"):
        clock.pass_s(SLICE_S / 10.0 * (end - begin))
        sizes.append(end - begin)
    assert sizes == [1, 4, 10, 10, 10, 10, 10, 5]


def test_slow_rounds_are_taken_one_at_a_time(clock):
    sizes = []
    for begin, end in NEVER.slices(4, "waiting"):
        clock.pass_s(2.0 * SLICE_S)
        sizes.append(end - begin)
    assert sizes == [1, 1, 1, 1]


def test_no_rounds_are_no_slices_even_when_it_is_over():
    assert list(Deadline.after(-1.0).slices(0, "nothing")) == []


def test_a_deadline_that_is_over_stops_the_loop_and_says_while_doing_what(clock):
    done = []
    with pytest.raises(OutOfTime, match=r"^out of time while counting sheep$") as fault:
        for begin, _ in Deadline.after(2.5 * SLICE_S).slices(1000, "counting sheep"):
            done.append(begin)
            clock.pass_s(SLICE_S)
    assert len(done) == 3
    assert fault.value.doing == "counting sheep"


def test_an_earlier_deadline_within_another(clock):
    whole = Deadline.after(10.0)
    assert whole.within(0.5).left_s == 5.0
    clock.pass_s(20.0)
    assert whole.within(0.5).left_s == 0.0
    assert NEVER.within(0.5) is NEVER
    assert NEVER.left_s == math.inf
    assert Deadline.after(None).is_never
