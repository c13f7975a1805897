"""Compiling what this machine has not compiled yet: by as many processes as there are cores, and with word of progress.

Compiled code is kept on disk (`flockopt.batches.kept`), so this happens once for a machine. `compiling` watches for the first
function of flockopt that is not there. Then processes of their own compile all of them, each handed one after another that
shares no uncompiled function with what the others are at (both would compile it), and the work that was watched goes on with
what they left on disk. Where all is there, nothing is asked of the disk and no process is started.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from threading import Condition, Thread
from types import TracebackType
from typing import IO, Any, Self

from numba.core import event
from numba.core.dispatcher import Dispatcher

from flockopt.batches.kept import is_kept

__all__ = ["compiling", "functions_under", "num_cores", "serve"]

#: Whose functions are counted, and compiled by processes of their own.
OWN = "flockopt."

#: More processes would mostly wait for each other, and each takes half a gigabyte.
MOST_PROCESSES = 8

#: How often what the processes have done is told, seconds.
TELL_S = 0.1


def num_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def functions_under(entry: Any) -> set[str]:
    """The compiled functions that one calls, and theirs, itself included, by module and name."""
    found, open_ends = set(), [entry]
    while open_ends:
        dispatcher = open_ends.pop()
        if (name := _name(dispatcher)) not in found:
            found.add(name)
            used = (dispatcher.py_func.__globals__.get(word) for word in dispatcher.py_func.__code__.co_names)
            open_ends += [value for value in used if isinstance(value, Dispatcher)]
    return found


def _name(dispatcher: Any) -> str:
    return f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__qualname__}"


@contextmanager
def compiling(
    entries: Callable[[], Mapping[str, Any]], command: Sequence[str], tell: Callable[[int, int], None]
) -> Iterator[None]:
    """Within the ``with`` statement, the first function under some entries that has to be compiled has all of them compiled.

    Args:
        entries: Gives the entries, see `flockopt.batches.compiled.ENTRIES`; called when there is something to compile.
        command: Starts a process that calls `serve` on the same entries.
        tell: Told how many functions are compiled, and of how many.
    """
    with event.install_listener("numba:compile", _Watch(entries, command, tell)):
        yield


class _Watch(event.Listener):  # type: ignore[misc]
    """Numba tells it of every function it compiles, not of those that it loads from disk."""

    def __init__(
        self, entries: Callable[[], Mapping[str, Any]], command: Sequence[str], tell: Callable[[int, int], None]
    ) -> None:
        self._entries, self._command, self._tell = entries, command, tell
        self._all: set[str] = set()
        self._done: set[str] = set()
        self._is_shared = False

    def on_start(self, event: Any) -> None:
        """A function is about to be compiled."""
        dispatcher = event.data["dispatcher"]
        if not (name := _name(dispatcher)).startswith(OWN) or name in self._all:
            return
        under = {} if self._is_shared else {name: functions_under(entry) for name, entry in self._entries().items()}
        if any(name in functions for functions in under.values()):
            self._is_shared = True
            self._all.update(*under.values())
            self._share(under)
        else:
            self._all |= functions_under(dispatcher)

    def on_end(self, event: Any) -> None:
        """It is compiled."""
        if (name := _name(event.data["dispatcher"])) in self._all:
            self._count({name})

    def _share(self, under: Mapping[str, set[str]]) -> None:
        self._count(set())
        if num_cores() > 1 and sys.executable and is_kept():  # they hand it over on disk
            # where no process can be started, this one does it all
            with suppress(OSError), _Processes(self._command, under) as processes:
                for done in processes.progress():
                    self._count(done)

    def _count(self, done: set[str]) -> None:
        self._done |= done & self._all  # numba's own functions are compiled too
        self._tell(len(self._done), len(self._all))


class _Processes:
    """Processes that compile; to be used in a ``with`` statement, after which there are none.

    Args:
        command: Starts one.
        under: The functions under each entry.
    """

    def __init__(self, command: Sequence[str], under: Mapping[str, set[str]]) -> None:
        # those with most under them first: that is what others wait for
        self._under, self._waiting = under, sorted(under, key=lambda name: -len(under[name]))
        self._at_work: dict[int, str] = {}  # by process
        self._done: set[str] = set()
        self._changed = Condition()
        self._processes: list[subprocess.Popen[str]] = []
        self._command = command

    def __enter__(self) -> Self:
        path = os.pathsep.join(part or os.getcwd() for part in sys.path)  # that it finds the same flockopt
        for _ in range(min(num_cores(), MOST_PROCESSES)):
            process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                env={**os.environ, "PYTHONPATH": path},
            )  # fmt: skip
            self._processes.append(process)
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        for process in self._processes:
            process.kill()
            process.wait()

    def progress(self) -> Iterator[set[str]]:
        """The functions compiled so far, again and again until all are; fewer where processes died."""
        threads = [Thread(target=self._drive, args=(process,), daemon=True) for process in self._processes]
        for thread in threads:
            thread.start()
        for thread in threads:
            while thread.is_alive():
                thread.join(TELL_S)
                with self._changed:
                    yield set(self._done)

    def _drive(self, process: subprocess.Popen[str]) -> None:
        """Hand a process one entry after another."""
        orders, answers = process.stdin, process.stdout
        assert orders is not None and answers is not None  # they are pipes
        with suppress(OSError):  # the process is gone
            while (name := self._next(process.pid)) is not None:
                print(name, file=orders, flush=True)
                for answer in answers:
                    if not answer.strip():
                        break
                    self._note({answer.strip()})
                else:
                    break
                self._note(self._under[name])
        with self._changed:
            self._at_work.pop(process.pid, None)
            self._changed.notify_all()

    def _note(self, done: set[str]) -> None:
        with self._changed:
            self._done |= done
            self._changed.notify_all()

    def _next(self, process: int) -> str | None:
        """An entry that nobody has begun and that shares nothing uncompiled with what others are at; None when none is left."""
        with self._changed:
            self._at_work.pop(process, None)
            while True:
                self._waiting = [name for name in self._waiting if not self._under[name] <= self._done]
                if not self._waiting:
                    return None
                taken = set().union(*(self._under[name] for name in self._at_work.values())) - self._done
                for name in self._waiting:
                    if not self._under[name] & taken:
                        self._waiting.remove(name)
                        self._at_work[process] = name
                        return name
                self._changed.wait()


def serve(entries: Mapping[str, Any], orders: IO[str], answers: IO[str]) -> None:
    """Compile the entries named, a line each; answers with every function compiled, and an empty line after each entry.

    It ends with its orders, or when nobody listens any more.
    """
    with event.install_listener("numba:compile", _Report(answers)):
        for order in orders:
            entries[order.strip()].compile()
            print(file=answers, flush=True)


class _Report(event.Listener):  # type: ignore[misc]
    def __init__(self, answers: IO[str]) -> None:
        self._answers = answers

    def on_start(self, event: Any) -> None:
        """Nothing is said of what begins."""

    def on_end(self, event: Any) -> None:
        """A function is compiled; a moment later it is on disk."""
        print(_name(event.data["dispatcher"]), file=self._answers, flush=True)
