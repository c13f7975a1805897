"""Strict reading of JSON files and checking of field values.

Files come from strangers: what is not known is refused, and every refusal names the field's path, the value
seen, the rule and the mend. Nothing that is read is ever executed.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, TypeVar

from flockopt.errors import FieldError

__all__ = [
    "Error", "choice", "flag", "from_keys", "integer", "keys", "number", "objects", "point", "share", "shown", "store", "text",
    "unique",
]  # fmt: skip

Error = type[FieldError]
Record = TypeVar("Record")


def shown(value: object) -> str:
    """A short form of a value for an error message."""
    words = repr(value)
    return words if len(words) <= 60 else words[:57] + "..."


def number(
    error: Error,
    field: str,
    value: Any,
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    mend: str = "",
) -> float:
    """A finite number, greater than ``above``, at least ``least`` and at most ``most`` where these are given."""
    limits = ((" > ", above), (" >= ", least), (" <= ", most))
    bound = " and".join(f"{sign}{limit:g}" for sign, limit in limits if limit is not None)
    rule = f"must be a finite number{bound}"
    if isinstance(value, bool) or not (isinstance(value, (int, float)) or _is_numpy_scalar(value)):
        raise error(field, f"is {shown(value)}", rule, mend or "give a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    low = (above is not None and not result > above) or (least is not None and not result >= least)
    if not math.isfinite(result) or low or (most is not None and result > most):
        raise error(field, f"is {shown(value)}", rule, mend or f"give a finite number{bound}")
    return result


def _is_numpy_scalar(value: Any) -> bool:
    return getattr(value, "shape", None) == () and getattr(getattr(value, "dtype", None), "kind", "") in "iuf"


def integer(error: Error, field: str, value: Any, *, least: int, most: int | None = None, mend: str = "") -> int:
    """A whole number, at least ``least`` and at most ``most`` if that is given; 3.0 is one, 3.5 and true are not."""
    bound = f" >= {least}" if most is None else f" from {least} to {most}"
    rule = f"must be an integer{bound}"
    number(error, field, value, mend=mend or rule)
    result = int(value)  # of the value itself: its float may be another whole number
    if result != value or result < least or (most is not None and result > most):
        raise error(field, f"is {shown(value)}", rule, mend or f"give a whole number{bound}")
    return result


def share(error: Error, field: str, value: Any) -> float:
    """A number from 0 to 1."""
    result = number(error, field, value)
    if not 0.0 <= result <= 1.0:
        raise error(field, f"is {result:g}", "must be from 0 to 1", "give a share")
    return result


def flag(error: Error, field: str, value: Any) -> bool:
    """True or false; 1 and 0 are neither."""
    if not isinstance(value, bool):
        raise error(field, f"is {shown(value)}", "must be true or false", "set one of the two")
    return value


def choice(error: Error, field: str, value: Any, *, known: Iterable[str], mend: str = "choose one") -> str:
    """One of the known names."""
    names = tuple(known)
    if not isinstance(value, str) or value not in names:
        raise error(field, f"is {shown(value)}", f"must be one of {', '.join(names)}", mend)
    return value


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
    """The record itself, once it is an object with every required key and no unknown one.

    An unknown key is told first, with the known one that it may be a slip of: who writes ``capcity`` lacks ``capacity``
    too, and would look in vain for what is wrong with it.
    """
    if not isinstance(record, dict):
        raise error("", f"is {shown(record)}", "must be an object", "put it in braces")
    required = tuple(required)
    known = (*required, *optional)
    for key in record:
        if key not in known:
            near = get_close_matches(str(key), known, n=1)
            guess = f"did you mean {near[0]}? " if near else ""
            rule = f"{guess}known keys are {', '.join(known)}"
            raise error(key, "is an unknown key", rule, "remove it or correct its spelling")
    for key in required:
        if key not in record:
            raise error(key, "is missing", "the key is required", "add it")
    return record


def from_keys(error: Error, make: Callable[..., Record], values: Any) -> Record:
    """What ``make`` makes of an object's values as its keywords, none of them required; an unknown key is an error."""
    return make(**keys(error, values, (), inspect.signature(make).parameters))


def store(record: object, check: Callable[..., Any], error: Error, *fields: str, **rules: Any) -> None:
    """Check fields of a frozen record that is being made, and store what the check gives: 3 where 3.0 was given.

    Args:
        record: To be called from its ``__post_init__``.
        check: One of this module's checks of a value, such as `integer`.
        error: What is raised.
        fields: Their names.
        rules: The check's own keywords, such as ``least=1``.
    """
    for field in fields:
        object.__setattr__(record, field, check(error, field, getattr(record, field), **rules))


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
