"""Strict reading of JSON files and checking of field values.

Files come from strangers: what is not known is refused, and every refusal names the field's path, the value
seen, the rule and the mend. Nothing that is read is ever executed.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from flockopt.errors import FieldError

__all__ = [
    "check_output", "integer", "keys", "number", "objects", "parse_json", "point", "read_json", "shown", "text", "unique",
    "write_whole",
]  # fmt: skip

Error = type[FieldError]
Record = TypeVar("Record")


def shown(value: object) -> str:
    """A short form of a value for an error message."""
    words = repr(value)
    return words if len(words) <= 60 else words[:57] + "..."


def number(
    error: Error, field: str, value: Any, *, above: float | None = None, least: float | None = None, mend: str = ""
) -> float:
    """A finite number, greater than ``above`` or at least ``least`` where these are given."""
    bound = f" > {above:g}" if above is not None else f" >= {least:g}" if least is not None else ""
    rule = f"must be a finite number{bound}"
    if isinstance(value, bool) or not (isinstance(value, (int, float)) or _is_numpy_scalar(value)):
        raise error(field, f"is {shown(value)}", rule, mend or "give a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    low = (above is not None and not result > above) or (least is not None and not result >= least)
    if not math.isfinite(result) or low:
        raise error(field, f"is {shown(value)}", rule, mend or f"give a finite number{bound}")
    return result


def _is_numpy_scalar(value: Any) -> bool:
    return getattr(value, "shape", None) == () and getattr(getattr(value, "dtype", None), "kind", "") in "iuf"


def integer(error: Error, field: str, value: Any, *, least: int, mend: str = "") -> int:
    """A whole number, at least ``least``; 3.0 is one, 3.5 and true are not."""
    rule = f"must be an integer >= {least}"
    result = number(error, field, value, mend=mend or rule)
    if result != int(result) or result < least:
        raise error(field, f"is {shown(value)}", rule, mend or f"give a whole number >= {least}")
    return int(result)


def text(error: Error, field: str, value: Any) -> str:
    """A string that is not empty."""
    if not isinstance(value, str) or not value:
        raise error(field, f"is {shown(value)}", "must be a non-empty string", "give it a name")
    if any("\ud800" <= letter <= "\udfff" for letter in value):  # JSON can hold half a character; UTF-8 cannot
        raise error(field, f"is {shown(value)}", "must be Unicode text without lone surrogates", "correct its \\u escapes")
    return value


def point(error: Error, field: str, value: Any) -> tuple[float, float, float]:
    """Three finite numbers: x, y, z."""
    if isinstance(value, (str, bytes)) or not hasattr(value, "__len__") or len(value) != 3 or isinstance(value, Mapping):
        raise error(field, f"is {shown(value)}", "must be a list of three numbers [x, y, z]", "give x, y and z")
    x, y, z = (number(error, f"{field}[{axis}]", value[axis]) for axis in range(3))
    return x, y, z


def keys(error: Error, record: Any, required: Iterable[str], optional: Iterable[str] = ()) -> dict[str, Any]:
    """The record itself, once it is an object with every required key and no unknown one."""
    if not isinstance(record, dict):
        raise error("", f"is {shown(record)}", "must be an object", "put it in braces")
    required, optional = tuple(required), tuple(optional)
    for key in required:
        if key not in record:
            raise error(key, "is missing", "the key is required", "add it")
    for key in record:
        if key not in required and key not in optional:
            known = ", ".join((*required, *optional))
            raise error(key, "is an unknown key", f"known keys are {known}", "remove it or correct its spelling")
    return record


def objects(error: Error, field: str, value: Any, build: Callable[[Any], Record]) -> tuple[Record, ...]:
    """A list whose every item is built by ``build``; errors in item 3 are named ``field[3]``."""
    if not isinstance(value, (list, tuple)):
        raise error(field, f"is {shown(value)}", "must be a list", "put it in brackets")
    records = []
    for index, item in enumerate(value):
        try:
            records.append(build(item))
        except FieldError as fault:
            raise fault.within(f"{field}[{index}]") from None
    return tuple(records)


def unique(error: Error, field: str, ids: Sequence[str]) -> None:
    """Ids within a list are all different."""
    first: dict[str, int] = {}
    for index, name in enumerate(ids):
        if name in first:
            raise error(
                f"{field}[{index}].id", f"is {shown(name)}, the same as {field}[{first[name]}].id",
                "ids must be unique within their list", "rename one of the two",
            )  # fmt: skip
        first[name] = index


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
    path = Path(path)
    try:
        content = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as fault:
        raise error("", f"{path} is not UTF-8 text ({fault.reason})", "the file must be UTF-8", "save it as UTF-8") from None
    except OSError as fault:
        raise error("", f"{path} cannot be read ({fault.strerror})", "it must be a readable file", "check the path") from None
    return parse_json(error, content, str(path))


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
