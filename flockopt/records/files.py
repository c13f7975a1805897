"""Files from strangers read strictly; files written whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from flockopt.errors import FieldError

__all__ = ["UTF_8", "check_output", "parse_json", "read_json", "read_text", "write_whole"]

Error = type[FieldError]

#: UTF-8, with or without the mark that some editors begin it with.
UTF_8 = "utf-8-sig"


def parse_json(error: Error, content: str, source: str) -> Any:
    """JSON with no repeated keys; ``source`` names the file in messages."""

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        record = dict(items)
        if len(record) < len(items):
            twice = next(key for index, (key, _) in enumerate(items) if key in dict(items[:index]))
            raise error(twice, "stands twice in one object", "keys must be unique", "remove one of the two")
        return record

    try:
        return json.loads(content, object_pairs_hook=pairs)
    except (ValueError, RecursionError) as fault:
        raise error("", f"{source} is not JSON ({fault})", "the file must be one JSON object", "correct it there") from None


def read_json(error: Error, path: str | Path) -> Any:
    """The JSON document in a file; whatever keeps it from being read becomes a named error."""
    return parse_json(error, read_text(error, path), str(path))


def read_text(error: Error, path: str | Path) -> str:
    """The text of a file in UTF-8, without a byte-order mark; whatever keeps it from being read becomes a named error."""
    try:
        return Path(path).read_text(encoding=UTF_8)
    except UnicodeDecodeError as fault:
        raise error("", f"{path} is not UTF-8 text ({fault.reason})", "the file must be UTF-8", "save it as UTF-8") from None
    except OSError as fault:
        raise error("", f"{path} cannot be read ({fault.strerror})", "it must be a readable file", "check the path") from None


def check_output(error: Error, path: str | Path) -> Path:
    """The real path of an output file, once nothing stands in the way of writing it.

    To be asked before long work too, so that its result is not lost at the end.
    """
    try:
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file():  # a directory, or a device that a rename would destroy
            kind = "a directory" if target.is_dir() else "not a regular file"
            raise error("", f"{path} is {kind}", "the output must be a writable file", "choose another path")
        with tempfile.TemporaryFile(dir=target.parent):
            return target
    except OSError as fault:
        raise _unwritable(error, path, fault) from None


def write_whole(error: Error, path: str | Path, content: str | bytes) -> None:
    """Write a file whole or not at all: into a temporary neighbour first, then renamed over the target."""
    target = check_output(error, path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name[:40]}.")
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
    except OSError as fault:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise _unwritable(error, path, fault) from None


def _unwritable(error: Error, path: str | Path, fault: OSError) -> FieldError:
    value = f"{path} cannot be written ({fault.strerror})"
    return error("", value, "the output must be a writable file", "choose another path")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
