"""The weights that come with the package: where they are, and what is made of them, once a process."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

__all__ = ["load_once", "shipped_path"]

FOLDER = Path(__file__).resolve().parents[1] / "weights"

Key = TypeVar("Key", bound=Hashable)
Made = TypeVar("Made")


def shipped_path(name: str) -> Path:
    """The file of weights that come with the package, such as ``"teacher"``."""
    return FOLDER / f"{name}.safetensors"


def load_once(load: Callable[[Key], Made], key: Key) -> Made:
    """What ``load`` makes of a path or a name; made the first time that it is asked for in this process."""
    made: Made = _made(load, key)
    return made


@cache
def _made(load: Callable[[Any], Any], key: Hashable) -> Any:
    return load(key)
