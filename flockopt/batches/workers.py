"""Work that outlives its workers: items are taken as there is room for them, and dead workers are replaced.

After a worker's death nobody knows which of the items under way brought it down. They are done again one at a time, so that
the next death has one name; an item that kills `MOST_DEATHS` workers is given up.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Generic, NamedTuple, TypeVar

from flockopt.batches.backends import Backend, open_backend, outcomes

__all__ = ["MOST_DEATHS", "Done", "done_by_workers"]

#: How many workers an item may bring down before it is given up.
MOST_DEATHS = 3

Item = TypeVar("Item")
Returned = TypeVar("Returned")


class Done(NamedTuple, Generic[Returned]):
    """What came of an item, and how often it was begun."""

    returned: Returned
    attempts: int = 1


def done_by_workers(
    items: Iterable[Item],
    work: Callable[[Item], Returned],
    *,
    key: Callable[[Item], str],
    given_up: Callable[[Item], Returned],
    jobs: int = 1,
    backend: str = "loky",
    parts: Callable[[Item], Sequence[Item]] = lambda item: (item,),
    warn: Callable[[str], object] = lambda words: None,
) -> Generator[Done[Returned], None, None]:
    """What comes of each item, as it comes.

    Items are taken by whoever reads what comes, a few for each worker ahead of that: whoever stops reading stops the taking.

    Args:
        items: All there is to do.
        work: What a worker does with an item.
        key: An item's name, one of a kind.
        given_up: What is said to have come of an item that killed too many workers.
        jobs: How many workers.
        backend: One of `flockopt.batches.backends.BACKENDS`.
        parts: What an item consists of, which is done again part by part after a worker's death; an item alone is itself.
        warn: Told, in words, of every dead worker.

    Raises:
        SettingsError: On an unknown backend.
        MissingExtra: If its package is not installed.
    """
    deaths: Counter[str] = Counter()
    line, suspects = _Line(iter(items), key), _Line[Item](iter(()), key)
    while True:
        alone = suspects.fill(1)
        round_ = suspects if alone else line
        # One job would work in this process, which is not to die with it.
        workers = max(jobs, 2) if alone else jobs
        with open_backend(backend, workers) as place:
            try:
                for name, returned in round_.outcomes(place, work, 1 if alone else 2 * workers):
                    yield Done(returned, min(1 + deaths[name], MOST_DEATHS))
            except place.deaths:
                fallen = round_.fallen()
            else:
                if not alone:
                    return
                continue
        deaths.update(map(key, fallen))
        warn(f"a worker died; doing again: {', '.join(map(key, fallen))}")
        again = [part for item in fallen for part in parts(item)]
        suspects.waiting.extendleft(item for item in reversed(again) if deaths[key(item)] < MOST_DEATHS)
        for item in again:
            if deaths[key(item)] >= MOST_DEATHS:
                yield Done(given_up(item), MOST_DEATHS)


@dataclass
class _Line(Generic[Item]):
    """Items on their way to workers.

    Attributes:
        source: Where they come from; asked only by whoever reads outcomes, as joblib's threads would lose what it raises.
        key: An item's name.
        waiting: Those that were taken from the source.
        under_way: Those that workers have, by name.
    """

    source: Iterator[Item]
    key: Callable[[Item], str]
    waiting: deque[Item] = field(default_factory=deque)
    under_way: dict[str, Item] = field(default_factory=dict)

    def fill(self, ahead: int) -> bool:
        """Take items until so many wait, if there are; whether any does."""
        self.waiting.extend(islice(self.source, max(ahead - len(self.waiting), 0)))
        return bool(self.waiting)

    def fallen(self) -> list[Item]:
        """Those that workers had; they have them no more."""
        items = list(self.under_way.values())
        self.under_way.clear()
        return items

    def outcomes(self, place: Backend, work: Callable[[Item], Returned], ahead: int) -> Iterator[tuple[str, Returned]]:
        """Name and outcome of each item, as it comes; where the line runs dry for a slow reader, it begins anew."""
        while self.fill(ahead):
            for name, returned in outcomes(place, partial(_named, work), self._leaving(), ahead):
                self.under_way.pop(name)
                self.fill(ahead)
                yield name, returned

    def _leaving(self) -> Iterator[tuple[str, Item]]:
        while self.waiting:
            item = self.waiting.popleft()
            name = self.key(item)
            self.under_way[name] = item
            yield name, item


def _named(work: Callable[[Item], Returned], named: tuple[str, Item]) -> tuple[str, Returned]:
    return named[0], work(named[1])
