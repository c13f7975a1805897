"""Where a batch runs: processes or threads of this machine, a Dask or a Ray cluster, all through joblib."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from itertools import islice
from typing import Any, NamedTuple, TypeVar

from flockopt.errors import SettingsError, require
from flockopt.records import checks

__all__ = ["BACKENDS", "Backend", "open_backend", "outcomes", "run_round"]

Item = TypeVar("Item")
Returned = TypeVar("Returned")


class Backend(NamedTuple):
    """What a batch must know of where it runs.

    Attributes:
        configured: Has joblib run there what is made within a ``with`` statement.
        deaths: Exceptions that say that a worker died.
        streams: Whether joblib can give each result as soon as it is there.
    """

    configured: Callable[[], AbstractContextManager[Any]]
    deaths: tuple[type[BaseException], ...]
    streams: bool = True


@contextmanager
def open_backend(name: str, jobs: int) -> Iterator[Backend]:
    """Have a backend there within a ``with`` statement; gives what to know of it, for `outcomes`.

    Args:
        name: One of `BACKENDS`.
        jobs: How many workers, where this process starts them.

    Raises:
        SettingsError: If there is no such backend.
        MissingExtra: If its package is not installed.
    """
    with BACKENDS[checks.choice(SettingsError, "backend", name, known=BACKENDS)](jobs) as backend:
        yield backend


def outcomes(
    place: Backend,
    work: Callable[[Item], Returned],
    items: Iterable[Item],
    ahead: int,
    begun: Callable[[Item], object] = lambda item: None,
) -> Iterator[Returned]:
    """What comes of each item, as it comes; within `open_backend`.

    Whoever reads it may use joblib in between as if nobody else did.

    Args:
        place: What `open_backend` gave.
        work: What a worker does with an item.
        items: All there is to do; a thread of joblib's may ask for the next one.
        ahead: How many items are handed out beyond what has come back, at most.
        begun: Told of every item that is handed out.
    """
    from joblib import Parallel, delayed

    def handed_out(some: Iterable[Item]) -> Iterator[object]:
        for item in some:
            begun(item)
            yield delayed(work)(item)

    if place.streams:
        with place.configured():
            parallel = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=ahead)
        running = parallel(handed_out(items))
        try:
            for returned in running:  # not `yield from`, which would close it before the warning is let be
                yield returned
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # who stops reading knows that some items are left
                running.close()
        return
    rest = iter(items)
    while some := list(islice(rest, ahead)):
        with place.configured():
            parallel = Parallel(batch_size=1)
        yield from parallel(handed_out(some))


def run_round(
    name: str,
    jobs: int,
    work: Callable[[Item], Returned],
    items: Sequence[Item],
    take: Callable[[Returned], object],
    *,
    ahead: int,
    begun: Callable[[Item], object] = lambda item: None,
) -> bool:
    """Do items until all are done or a worker dies: whether all are done.

    Args:
        name: One of `BACKENDS`.
        jobs: How many workers.
        work: What a worker does with an item.
        items: All there is to do.
        take: Told of what comes of each item, as it comes.
        ahead: How many items are handed out beyond what has come back, at most.
        begun: Told of every item that is handed out.
    """
    with open_backend(name, jobs) as place:
        try:
            for returned in outcomes(place, work, items, ahead, begun):
                take(returned)
        except place.deaths:
            return False
    return True


@contextmanager
def _processes(jobs: int) -> Iterator[Backend]:
    from joblib import parallel_config
    from joblib.externals.loky.process_executor import BrokenProcessPool

    yield Backend(partial(parallel_config, backend="loky", n_jobs=jobs, inner_max_num_threads=1), (BrokenProcessPool,))


@contextmanager
def _threads(jobs: int) -> Iterator[Backend]:
    from joblib import parallel_config

    yield Backend(partial(parallel_config, backend="threading", n_jobs=jobs), ())


@contextmanager
def _dask(jobs: int) -> Iterator[Backend]:
    """The cluster that the environment variable DASK_SCHEDULER_ADDRESS names, or workers of this machine."""
    require("distributed", extra="cluster")
    from dask import config
    from distributed import Client, KilledWorker, LocalCluster
    from joblib import parallel_config

    place = Backend(partial(parallel_config, backend="dask"), (KilledWorker,))
    address = config.get("scheduler-address", None)
    if address is not None:
        with Client(address):
            yield place
        return
    local = LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address=None, host="127.0.0.1")
    with local, Client(local):
        yield place


@contextmanager
def _ray(jobs: int) -> Iterator[Backend]:
    """The cluster that the environment variable RAY_ADDRESS names, or workers of this machine."""
    ray = require("ray", extra="cluster")
    import os

    from joblib import parallel_config
    from ray.util.joblib import register_ray

    local: dict[str, Any] = {} if "RAY_ADDRESS" in os.environ else {"num_cpus": jobs, "include_dashboard": False}
    ray.init(log_to_driver=False, configure_logging=False, **local)
    register_ray()
    deaths = ray.exceptions.RayActorError, ray.exceptions.WorkerCrashedError
    try:
        yield Backend(partial(parallel_config, backend="ray", n_jobs=jobs), deaths, streams=False)
    finally:
        ray.shutdown()


BACKENDS: dict[str, Callable[[int], AbstractContextManager[Backend]]] = {
    "loky": _processes,
    "dask": _dask,
    "ray": _ray,
    "threading": _threads,
}
