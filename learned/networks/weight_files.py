"""Weight files: tensors in safetensors, with the settings that made them in the header; never pickle.

The header's metadata holds ``format`` (`FORMAT`), ``kind`` (whose weights they are) and ``settings`` (a JSON object,
normalisers included). Files come from strangers: whatever is wrong with one is a named error.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockopt.errors import SettingsError, require
from flockopt.records import checks, files

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["FORMAT", "file_digest", "load_weights", "save_weights", "to_bytes", "to_floats"]

FORMAT = "flockopt.weights/1"

MEND = "train the weights again or fetch the file anew"

#: What `to_bytes` calls the parts of a matrix.
ROWS, SCALES = "/rows", "/scales"


def save_weights(path: str | Path, tensors: Mapping[str, Tensor], kind: str, settings: Mapping[str, Any]) -> None:
    """Write weights, whole or not at all.

    Args:
        path: Where; an older file is replaced.
        tensors: By name.
        kind: Whose weights they are, such as ``"teacher"``; `load_weights` asks for the same.
        settings: What else is needed to use them; a JSON object.

    Raises:
        SettingsError: If the file cannot be written, or the settings are not JSON.
        MissingExtra: If safetensors is not installed.
    """
    save = require("safetensors.torch", extra="learned").save
    try:
        header = json.dumps(dict(settings), allow_nan=False, sort_keys=True)
    except (TypeError, ValueError) as fault:
        raise SettingsError("settings", f"cannot be written ({fault})", "must be a JSON object", "use plain values") from None
    metadata = {"format": FORMAT, "kind": kind, "settings": header}
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    files.write_whole(SettingsError, path, save(plain, metadata))


def load_weights(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors by name, on the CPU, and the settings in the file's header.

    Args:
        path: A file that `save_weights` wrote.
        kind: Whose weights they must be.

    Raises:
        SettingsError: If the file is missing, damaged, foreign or of another kind, or holds values that are not finite.
        MissingExtra: If safetensors or torch is not installed.
    """
    torch, safetensors = require("torch", extra="learned"), require("safetensors", extra="learned")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            settings = _settings(path, kind, file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - the file is no dictionary
    except OSError as fault:
        raise _unreadable(path, fault) from None
    except safetensors.SafetensorError as fault:
        raise SettingsError("weights", f"{path} is damaged ({fault})", "must be a safetensors file", MEND) from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise SettingsError("weights", f"{path} holds {name!r} with NaN or infinity", "weights are finite", MEND)
    return tensors, settings


def _unreadable(path: str | Path, fault: OSError) -> SettingsError:
    words = fault.strerror or str(fault)
    return SettingsError("weights", f"{path} cannot be read ({words})", "it must be a readable file", MEND)


def _settings(path: str | Path, kind: str, metadata: Mapping[str, str]) -> dict[str, Any]:
    """The settings of a header, once it is one of ours and of this kind."""
    if metadata.get("format") != FORMAT:
        value = f"{path} has the format {checks.shown(metadata.get('format'))}"
        raise SettingsError("weights", value, f'must be "{FORMAT}"', "name a file that this package wrote")
    if metadata.get("kind") != kind:
        value = f"{path} is for {checks.shown(metadata.get('kind'))}"
        raise SettingsError("weights", value, f"must be for {kind!r}", "name the right file")
    settings = files.parse_json(SettingsError, metadata.get("settings", ""), f"the settings in {path}")
    if not isinstance(settings, dict):
        raise SettingsError("weights", f"{path} has settings {checks.shown(settings)}", "must be a JSON object", MEND)
    return settings


def file_digest(path: str | Path) -> str:
    """The SHA-256 of a weight file, in hexadecimal: which weights these are.

    Raises:
        SettingsError: If it cannot be read.
    """
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as fault:
        raise _unreadable(path, fault) from None


def to_bytes(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Matrices as signed bytes with a scale for each row: half the size of bfloat16; other tensors as they are.

    A value is off by at most 1/254 of the largest in its row.
    """
    import torch

    result = {}
    for name, value in tensors.items():
        if value.dim() != 2:
            result[name] = value
            continue
        scales = value.float().abs().amax(dim=1, keepdim=True).clamp(min=torch.finfo(torch.float32).tiny) / 127.0
        result |= {name + ROWS: (value.float() / scales).round().to(torch.int8), name + SCALES: scales}
    return result


def to_floats(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The inverse of `to_bytes`, in single precision; tensors that were never bytes are taken as they are."""
    whole = {name: value.float() for name, value in tensors.items() if not name.endswith((ROWS, SCALES))}
    for name, rows in tensors.items():
        scales = tensors.get(name.removesuffix(ROWS) + SCALES)
        if name.endswith(ROWS) and scales is not None:
            whole[name.removesuffix(ROWS)] = rows.float() * scales.float()
    return whole
