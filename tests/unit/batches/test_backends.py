"""Rounds of a batch: everything is taken as it comes, and a dead worker ends a round and not this process."""

from __future__ import annotations

import os

import pytest

from flockopt.batches.backends import run_round
from flockopt.errors import SettingsError


def doubled(number):
    if number < 0:
        os._exit(1)
    return 2 * number


@pytest.mark.parametrize("backend", ["threading", "loky"])
def test_a_round_takes_what_comes_of_every_item(backend):
    taken, begun = [], []
    assert run_round(backend, 2, doubled, range(5), taken.append, ahead=2, begun=begun.append)
    assert sorted(taken) == [0, 2, 4, 6, 8] and begun == list(range(5))


def test_a_dead_worker_ends_a_round():
    taken = []
    assert not run_round("loky", 2, doubled, [1, -1, 2, 3], taken.append, ahead=1)
    assert set(taken) <= {2, 4, 6}


def test_an_unknown_backend_is_named():
    with pytest.raises(SettingsError, match="backend is 'cloud'; must be one of loky, dask, ray, threading"):
        run_round("cloud", 1, doubled, [], print, ahead=1)
