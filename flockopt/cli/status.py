"""Exit statuses: what every command line of this house ends with, and its one line on bad input."""

from __future__ import annotations

import sys
from collections.abc import Callable

from flockopt.cli.text import printable
from flockopt.errors import FlockError

__all__ = ["INTERRUPTED", "refuse", "run_command"]

#: Bad input, or a tool that is missing or broken; interrupted from the keyboard.
BAD_INPUT, INTERRUPTED = 2, 130


def run_command(name: str, work: Callable[[], int | None]) -> int:
    """The exit status of a command: its own, 0 where it gives none, and 2 with a line on stderr on a `FlockError`.

    Args:
        name: What the line begins with.
        work: The command.
    """
    try:
        return work() or 0
    except FlockError as fault:
        return refuse(name, str(fault), BAD_INPUT)


def refuse(name: str, message: str, status: int) -> int:
    """The status, once a line on stderr has said why."""
    print(f"{name}: {printable(message)}", file=sys.stderr)
    return status
