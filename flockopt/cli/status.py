"""Exit statuses: what every command line of this house ends with, and its one line where something is wrong."""

from __future__ import annotations

import io
import os
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress

from flockopt.batches.deadline import is_still_at_work
from flockopt.cli.text import let_go, printable
from flockopt.errors import FlockError, is_interrupt

__all__ = ["FAILED", "INTERRUPTED", "refuse", "run_command"]

#: Bad input, or a tool that is missing or broken; what nobody foresaw; interrupted from the keyboard.
BAD_INPUT, FAILED, INTERRUPTED = 2, 3, 130

#: Set in the environment, it has an unforeseen failure tell where it happened.
TRACEBACK = "FLOCKOPT_TRACEBACK"


def run_command(name: str, work: Callable[[], int | None]) -> int:
    """The exit status of a command: its own, 0 where it gives none, and others with a line on stderr that says why.

    2 on a `FlockError`; 3 where the machine fails it (a full disk behind stdout, no memory) or the program has a fault; 130
    where it is interrupted from the keyboard.

    Args:
        name: What the line begins with.
        work: The command.
    """
    _mend_streams()
    try:
        status = work() or 0
        sys.stdout.flush()
        return status
    except FlockError as fault:
        return refuse(name, str(fault), BAD_INPUT)
    except (KeyboardInterrupt, Exception) as fault:
        if is_interrupt(fault):
            return _interrupted(name)
        let_go(sys.stdout)
        if os.environ.get(TRACEBACK):
            traceback.print_exception(fault)
        return refuse(name, _words(fault), FAILED)


def refuse(name: str, message: str, status: int) -> int:
    """The status, once a line on stderr has said why."""
    with suppress(OSError):
        print(f"{name}: {printable(message)}", file=sys.stderr, flush=True)
    return status


def _interrupted(name: str) -> int:
    refuse(name, "interrupted; no output was written after this point", INTERRUPTED)
    if is_still_at_work():
        os._exit(INTERRUPTED)  # a solver in a thread would keep the process, or crash it
    return INTERRUPTED


def _words(fault: BaseException) -> str:
    if isinstance(fault, MemoryError):
        return "out of memory; plan fewer drones, tasks or obstacles at a time, or give it more"
    if isinstance(fault, OSError):
        return f"the machine refuses: {fault.strerror or fault}{f' ({fault.filename})' if fault.filename else ''}"
    kind = type(fault).__name__
    return f"a fault of the program, not of its input: {kind}: {fault}; report it, with what {TRACEBACK}=1 says"


def _mend_streams() -> None:
    """Streams that were closed swallow what is written; what they cannot encode is written as escapes."""
    for stream in ("stdin", "stdout", "stderr"):
        if getattr(sys, stream) is None:
            setattr(sys, stream, os.fdopen(os.open(os.devnull, os.O_RDWR), "r" if stream == "stdin" else "w", encoding="utf-8"))
    for output in (sys.stdout, sys.stderr):
        if isinstance(output, io.TextIOWrapper):
            output.reconfigure(errors="backslashreplace")
