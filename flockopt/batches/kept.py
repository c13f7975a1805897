"""Compiled code kept on disk: one file for each function, signature and machine, named by a digest of all that went into it.

The digest covers the function's bytecode and constants, the compiled functions that it calls and theirs, records and options,
and the versions of numba and Python. So a file never has to be told from a stale one, checkouts and versions share a place, and
a change recompiles what it concerns and nothing else. What cannot be read is passed over and made anew; what cannot be written
is not kept.

The place is numba's own ``NUMBA_CACHE_DIR`` where that is set, else the user's cache directory, else a directory of the user's
in the system's temporary one, where nobody else can write.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import stat
import sys
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.core.types.containers import BaseNamedTuple, BaseTuple

__all__ = ["KeptCode", "digest_of", "is_kept", "place"]

#: Files that nobody has used for so long are removed, seconds.
LONGEST_UNUSED_S = 60 * 86400.0


@cache
def place() -> Path | None:
    """The directory that compiled code is kept in; None where there is none.

    One that ``NUMBA_CACHE_DIR`` names is trusted, and need not be writable: an image may come with one.
    """
    if numba.config.CACHE_DIR:
        given = Path(numba.config.CACHE_DIR) / "flockopt"
        with suppress(OSError):
            given.mkdir(parents=True, exist_ok=True)
        return given if given.is_dir() else None
    user = os.getuid() if hasattr(os, "getuid") else "cache"
    for folder in (*_in_home(), Path(tempfile.gettempdir()) / f"flockopt-{user}"):
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_ours(folder):
                tempfile.TemporaryFile(dir=folder).close()
                _prune(folder)
                return folder
    return None


def is_kept() -> bool:
    """Whether what is compiled now will be there for the next process."""
    folder = place()
    return folder is not None and os.access(folder, os.W_OK)


def _in_home() -> list[Path]:
    """The user's cache directory, if there is a home."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):
        return [Path(given) / "flockopt"]
    try:
        home = Path.home()
    except RuntimeError:
        return []
    return [home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "flockopt"]


def _is_ours(folder: Path) -> bool:
    """Whether nobody else can have put code there."""
    found = folder.stat()
    if not hasattr(os, "getuid"):
        return True
    return found.st_uid == os.getuid() and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _prune(folder: Path) -> None:
    """Remove what has not been used for long."""
    oldest = time.time() - LONGEST_UNUSED_S
    for file in folder.iterdir():
        with suppress(OSError):
            if file.stat().st_mtime < oldest:
                file.unlink()


class KeptCode:
    """What a dispatcher of numba asks for compiled code before it compiles, and gives it to afterwards.

    Args:
        dispatcher: Whose code it is.
    """

    def __init__(self, dispatcher: Any) -> None:
        self._dispatcher = dispatcher

    @property
    def cache_path(self) -> str | None:
        """The directory, for numba's statistics."""
        folder = place()
        return None if folder is None else str(folder)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The code for a signature, or None where it is not there or of no use."""
        target.refresh()
        file = self._file(signature, target.codegen())
        try:
            payload = pickle.loads(file.read_bytes()) if file is not None else None
            if file is None or payload is None:
                return None
            result = CompileResult._rebuild(target, *payload)
        except Exception:  # it is not there, or damaged: unpickling may raise anything
            return None
        with suppress(OSError):
            os.utime(file)
        return result

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the code for a signature, whole or not at all."""
        file = self._file(signature, result.codegen)
        if file is None or any(not lifted.can_cache for lifted in result.lifted) or result.library.has_dynamic_globals:
            return
        with suppress(OSError):  # a full disk
            handle, temporary = tempfile.mkstemp(dir=file.parent, prefix=".")
            try:
                with os.fdopen(handle, "wb") as stream:
                    stream.write(dumps(result._reduce()))
                os.chmod(temporary, 0o644)  # an image may be made by one user and run by another
                os.replace(temporary, file)
            except OSError:
                os.unlink(temporary)
                raise

    def _file(self, signature: Any, codegen: Any) -> Path | None:
        folder, function = place(), self._dispatcher.py_func
        if folder is None:
            return None
        versions = numba.__version__, sys.implementation.cache_tag, codegen.magic_tuple()
        key = repr((digest_of(self._dispatcher), _described(signature), versions))
        name = f"{function.__module__}.{function.__qualname__}".replace("<", "").replace(">", "")
        return folder / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:32]}"

    def flush(self) -> None:
        """Nothing is held back."""

    def enable(self) -> None:
        """It is."""

    def disable(self) -> None:
        """Numba asks for that only where it is told not to compile."""


@cache
def digest_of(dispatcher: Any) -> str:
    """A digest of a compiled function and of all that it calls, in hexadecimal."""
    parts: dict[int, Any] = {}
    _gather(dispatcher, parts)
    return hashlib.sha256(repr(list(parts.values())).encode()).hexdigest()


def _gather(dispatcher: Any, parts: dict[int, Any]) -> None:
    """What a function is made of, and the compiled ones that it calls, each once, in the order in which they are met."""
    if id(dispatcher) in parts:
        return
    function = dispatcher.py_func
    options = sorted((name, repr(value)) for name, value in dispatcher.targetoptions.items())
    arguments = [_described(kind) for kind in getattr(dispatcher, "arguments", ())]
    parts[id(dispatcher)] = record = [
        function.__module__,
        function.__qualname__,
        options,
        arguments,
        repr(function.__defaults__),
    ]
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    for value in [*_named(function.__code__, function.__globals__, record), *cells]:
        if isinstance(value, Dispatcher):
            _gather(value, parts)
            record.append(value.py_func.__qualname__)
        else:
            record.append(_described(value))


def _named(code: CodeType, names: dict[str, Any], record: list[Any]) -> list[Any]:
    """What a function's names stand for; its bytecode goes into its record."""
    values = [names[name] for name in code.co_names if name in names]
    record.append((code.co_code, code.co_names, code.co_varnames, code.co_freevars))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            values += _named(constant, names, record)
        else:
            record.append(repr(constant))
    return values


def _described(value: Any) -> Any:
    """A value that a compiled function holds, in words that differ where the code may differ."""
    if isinstance(value, BaseNamedTuple):
        return _described(value.instance_class), [_described(part) for part in value.types]
    if isinstance(value, tuple | list | BaseTuple):
        return [_described(part) for part in value]
    if isinstance(value, type):
        return value.__module__, value.__qualname__, getattr(value, "_fields", ())
    if isinstance(value, ModuleType):
        return value.__name__
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return value.__name__ if callable(value) and hasattr(value, "__name__") else repr(value)
