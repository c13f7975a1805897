"""Compiled functions of one signature each: compiled when first called, or all of them beforehand.

`numba.njit` compiles a signature that it is given while the module is imported; without one it compiles the function
anew for every kind of argument: read-only arrays and writable ones, integers and literal ones. `compiled_for` does neither,
and knows all its functions, so that they can be compiled before anybody calls them (`flockopt.batches.compiling`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import config, njit, types
from numba.core.compiler_lock import global_compiler_lock

from flockopt.batches.kept import KeptCode

__all__ = [
    "ENTRIES",
    "FLAGS_1",
    "FLAGS_2",
    "FLOATS_1",
    "FLOATS_2",
    "FLOATS_3",
    "INNER",
    "INTEGERS_1",
    "INTEGERS_2",
    "compiled_for",
    "compiled_lazily",
    "record_of",
    "writable",
]  # fmt: skip

#: Every function of `compiled_for`, by module and name; a call of its ``compile`` makes it, or loads it from disk.
ENTRIES: dict[str, Any] = {}

#: Options of a function that only compiled ones call: numba makes it no way in from Python, which takes long for records.
INNER = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

# Read-only views of contiguous arrays: writable ones convert to them.
FLOATS_1, FLOATS_2, FLOATS_3 = (types.Array(types.float64, n, "C", readonly=True) for n in (1, 2, 3))
INTEGERS_1, INTEGERS_2 = (types.Array(types.int64, n, "C", readonly=True) for n in (1, 2))
FLAGS_1, FLAGS_2 = (types.Array(types.boolean, n, "C", readonly=True) for n in (1, 2))


def writable(array: types.Array) -> types.Array:
    """The same kind of array, to be written to."""
    return array.copy(readonly=False)


def record_of(kind: type, *fields: object) -> types.NamedTuple:
    """Numba's type of a named tuple, whose arrays are writable."""
    return types.NamedTuple([writable(field) if isinstance(field, types.Array) else field for field in fields], kind)


def compiled_lazily(**options: object) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: `numba.njit` for whatever arguments a function is called with, mostly by compiled ones; kept on disk.

    Args:
        options: As of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**options)(function)
        if not config.DISABLE_JIT:
            dispatcher._cache = KeptCode(dispatcher)
        return dispatcher

    return decorate


def compiled_for(*arguments: object, **options: object) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: `numba.njit` for arguments of these types, to which what it is called with is converted; kept on disk.

    Args:
        arguments: Numba's types of the arguments.
        options: As of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = compiled_lazily(no_cfunc_wrapper=True, **options)(function)
        if config.DISABLE_JIT:
            return dispatcher
        dispatcher.arguments = arguments
        compile_any = dispatcher.compile
        entry_points: list[Any] = []

        def compile_this(_: object = None) -> Any:
            with global_compiler_lock:
                if not entry_points:
                    entry_points.append(compile_any(arguments))
                    dispatcher.disable_compile()
            return entry_points[0]

        dispatcher.compile = compile_this
        ENTRIES[f"{function.__module__}.{function.__qualname__}"] = dispatcher
        return dispatcher

    return decorate
