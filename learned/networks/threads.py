"""How many threads a network's answer is worth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["one_thread", "threads_for"]

#: Fewer drones and tasks than this are answered by one thread. More gain nothing there; and where other work holds the cores,
#: threads that wait for each other take a hundred times as long.
FEW_PLACES = 400


@contextmanager
def threads_for(num_places: int) -> Iterator[None]:
    """Torch's threads for scenes of so many drones and tasks in all; those of the process again afterwards."""
    if num_places >= FEW_PLACES:
        yield
        return
    with one_thread():
        yield


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch's; those of the process again afterwards."""
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
