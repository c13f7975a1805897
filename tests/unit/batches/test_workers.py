"""Work that outlives its workers: taken as it is read, done again after a death, given up after too many."""

from __future__ import annotations

import os
import signal
import threading
from functools import partial

import pytest
from joblib import Parallel

from flockopt.batches.backends import BACKENDS
from flockopt.batches.workers import MOST_DEATHS, done_by_workers

NUMBERS = [str(number) for number in range(12)]


def length(words):
    return len(words)


def stumbling(words, folder, deadly, times):
    """Kill the worker that has the deadly word among its own, the first few times."""
    falls = len(list(folder.glob("fall-*")))
    if deadly in words.split() and falls < times:
        (folder / f"fall-{falls}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return words


def done(items, work, **keywords):
    return done_by_workers(items, work, key=str, given_up=lambda item: f"given up: {item}", **keywords)


@pytest.mark.parametrize("backend", ["threading", "loky"])
@pytest.mark.parametrize("jobs", [1, 2])
def test_every_item_is_done_once(backend, jobs):
    items = ["x" * number for number in range(1, 30)]
    assert sorted(result.returned for result in done(iter(items), length, backend=backend, jobs=jobs)) == [*range(1, 30)]


@pytest.mark.parametrize("streams", [True, False])
@pytest.mark.parametrize("jobs", [1, 2])
def test_items_are_taken_as_outcomes_are_read_and_by_who_reads_them(jobs, streams, monkeypatch):
    taken, threads = [], set()

    def source():
        for number in range(10**9):
            taken.append(number)
            threads.add(threading.get_ident())
            yield str(number)

    if not streams:
        from contextlib import contextmanager

        @contextmanager
        def in_groups(jobs, inner=BACKENDS["threading"]):
            with inner(jobs) as place:
                yield place._replace(streams=False)

        monkeypatch.setitem(BACKENDS, "threading", in_groups)
    results = done(source(), length, backend="threading", jobs=jobs)
    assert taken == []
    for read in range(1, 40):
        next(results)
        assert len(taken) <= read + 6 * jobs
    results.close()
    assert threads == {threading.get_ident()}


def test_what_the_source_raises_is_raised():
    def source():
        yield "one"
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(done(source(), length, backend="threading", jobs=2))


def test_who_reads_may_use_joblib_meanwhile():
    for _ in done(NUMBERS, length, backend="threading", jobs=2):
        assert Parallel().n_jobs == 1


@pytest.mark.parametrize("times", [1, MOST_DEATHS])
def test_a_dead_worker_is_replaced_and_its_item_done_again(tmp_path, times):
    warnings = []
    work = partial(stumbling, folder=tmp_path, deadly="7", times=times)
    results = list(done(NUMBERS, work, jobs=2, warn=warnings.append))
    (deadly,) = [result for result in results if "7" in result.returned]
    assert len(warnings) == times and all("7" in words for words in warnings)
    assert deadly == (("7", 2) if times == 1 else ("given up: 7", MOST_DEATHS))
    assert sorted(result.returned for result in results if result != deadly) == sorted({*NUMBERS} - {"7"})


def test_after_a_death_items_are_done_part_by_part(tmp_path):
    work = partial(stumbling, folder=tmp_path, deadly="4", times=99)
    results = list(done(["1 2", "3 4", "5 6"], work, jobs=2, parts=str.split))
    found = {word for result in results for word in result.returned.removeprefix("given up: ").split()}
    assert found == {*"123456"} and ("given up: 4", MOST_DEATHS) in results
    assert not any("given up" in result.returned and "3" in result.returned for result in results)
