"""Long runs that write shards of scenes: stopped and started again, they go on with the shards that are missing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from flockopt.batches.backends import run_round
from flockopt.batches.run_folder import RunFolder
from flockopt.errors import SettingsError
from learned.demonstrations.array_files import Arrays, shard_path

__all__ = ["ShardRun"]

#: How often a batch begins again after a worker has died.
MOST_DEATHS = 3


@dataclass(frozen=True)
class ShardRun:
    """A folder of shards, and what makes them.

    Attributes:
        folder: Where; made if it does not exist.
        terms: What all shards of the folder share.
        content: What they hold, in words for errors.
        make: The arrays of a shard, from the seeds of its scenes; must be picklable for processes.
        write: Puts them in a file.
        size: How many scenes a file holds.
        shard_scenes: Scenes in a shard: what is lost when a run is killed.
        seed: Of the first scene; the others follow.
    """

    folder: Path
    terms: dict[str, Any]
    content: str
    make: Callable[[Sequence[int]], Arrays]
    write: Callable[[Path, Arrays], None]
    size: Callable[[Path], int]
    shard_scenes: int
    seed: int

    def go(
        self,
        num_scenes: int,
        *,
        jobs: int = 1,
        backend: str = "loky",
        begun: Callable[[int, int], object] = lambda total, done: None,
        done: Callable[[str], object] = lambda words: None,
        warn: Callable[[str], object] = lambda words: None,
    ) -> None:
        """Write all shards that the folder does not hold yet.

        Args:
            num_scenes: How many scenes it shall hold.
            jobs: Workers.
            backend: One of `flockopt.batches.backends.BACKENDS`.
            begun: Told once how many shards there are to be and how many are there.
            done: Told of every shard that is written.
            warn: Told of dead workers.

        Raises:
            SettingsError: If the folder holds another run, is in use, or holds damaged shards.
        """
        with RunFolder(self.folder, self.terms, self.content):
            shards = list(self._shards(num_scenes))
            missing = self._missing(shards)
            begun(len(shards), len(shards) - len(missing))
            for deaths in range(MOST_DEATHS + 1):
                if self._round(missing, jobs, backend, done):
                    return
                warn(f"a worker died ({deaths + 1} of {MOST_DEATHS}); going on with the shards that are missing")
                missing = self._missing(missing)
        raise SettingsError("jobs", f"is {jobs}", "workers must live", "take fewer, or look for why they die (memory?)")

    def _round(self, shards: Sequence[tuple[int, range]], jobs: int, backend: str, done: Callable[[str], object]) -> bool:
        """Make shards until all are there, or until a worker dies: whether all are there."""

        def take(made: tuple[int, Arrays]) -> None:
            path = shard_path(self.folder, made[0])
            self.write(path, made[1])
            done(path.name)

        return run_round(backend, jobs, partial(_work, self.make), shards, take, ahead=2 * jobs)

    def _shards(self, num_scenes: int) -> Iterator[tuple[int, range]]:
        """Number and seeds of every shard."""
        for number, begin in enumerate(range(0, num_scenes, self.shard_scenes)):
            yield number, range(self.seed + begin, self.seed + min(begin + self.shard_scenes, num_scenes))

    def _missing(self, shards: Sequence[tuple[int, range]]) -> list[tuple[int, range]]:
        """Shards that are not there, or hold too few scenes."""
        return [shard for shard in shards if self._size(shard_path(self.folder, shard[0])) < len(shard[1])]

    def _size(self, path: Path) -> int:
        return self.size(path) if path.exists() else 0


def _work(make: Callable[[Sequence[int]], Arrays], shard: tuple[int, range]) -> tuple[int, Arrays]:
    return shard[0], make(shard[1])
