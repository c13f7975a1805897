"""Arrays in files: ``.npz`` without pickle, written whole and read strictly; files may come from strangers."""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SettingsError
from flockopt.records import checks, files

__all__ = ["ArrayLayout", "Arrays", "layout_faults", "read_arrays", "shard_path", "write_arrays"]

Arrays = dict[str, NDArray[Any]]

#: Kind of number and shape of arrays by name; letters stand for lengths.
ArrayLayout: TypeAlias = "Mapping[str, tuple[type[np.generic], tuple[int | str, ...]]]"

#: What numpy and zipfile raise on damaged files, encryption and unknown compression included.
UNREADABLE = (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError)


def shard_path(folder: Path, number: int) -> Path:
    """Where a shard is."""
    return folder / f"shard-{number:05d}.npz"


def write_arrays(path: Path, arrays: Arrays, file_format: str) -> None:
    """Write arrays, whole or not at all; equal arrays give equal bytes."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, format=np.array(file_format), **arrays)
    files.write_whole(SettingsError, path, content.getvalue())


def read_arrays(path: Path, layout: ArrayLayout, file_format: str, mend: str) -> Arrays:
    """The arrays of a file that holds those of a layout and no others; `layout_faults` looks into them.

    Raises:
        SettingsError: Naming the file.
    """
    rule = f"must be a shard of format {file_format}"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except UNREADABLE as fault:
        raise SettingsError("data", f"{path} cannot be read ({fault})", rule, mend) from None
    found = arrays.pop("format", None)
    if found is None or str(found) != file_format or set(arrays) != set(layout):
        seen = f"{path} holds {checks.shown(sorted(arrays))} of format {checks.shown(None if found is None else str(found))}"
        raise SettingsError("data", seen, rule, mend)
    return arrays


def layout_faults(
    arrays: Arrays, layout: ArrayLayout, sizes: Mapping[int | str, int], offsets: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    """What is wrong with shapes, kinds, numbers and offsets, as name and complaint; what comes after may hang on it.

    Args:
        arrays: By the names of the layout.
        layout: What they must be.
        sizes: How long each letter is.
        offsets: Arrays that must rise from 0 to the length of an axis, by name, with its letter.
    """
    for name, (kind, axes) in layout.items():
        array, shape = arrays[name], tuple(sizes.get(axis, axis) for axis in axes)
        if not np.issubdtype(array.dtype, kind) or array.shape != shape:
            yield name, f"is {array.dtype} {array.shape}, not {kind.__name__} {shape}"
            return
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            yield name, f"is not finite at {tuple(map(int, np.argwhere(~np.isfinite(array))[0]))}"
    for name, axis in offsets.items():
        at = arrays[name]
        if at[0] != 0 or at[-1] != sizes[axis] or (np.diff(at) < 0).any():
            yield name, f"does not rise from 0 to {sizes[axis]}"
            return
