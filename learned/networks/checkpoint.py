"""What a training run needs to go on exactly where it stopped: weights, their average, and the optimiser's moments."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from flockopt.errors import SettingsError
from learned.networks.weight_files import load_weights, save_weights, to_floats

__all__ = ["CHECKPOINT_KIND", "fill", "in_bfloat16", "load_network", "restore", "save_checkpoint"]

Settings = TypeVar("Settings")
Trained = TypeVar("Trained", bound=nn.Module)

#: The kind of weight file that a checkpoint is.
CHECKPOINT_KIND = "student-checkpoint"

MEND = "take the file of a run with these settings, or start anew in another folder"


def in_bfloat16(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights as they are stored for inference; the spread of samples stays exact."""
    return {name: value.to(torch.bfloat16) if name != "spread" else value for name, value in weights.items()}


def fill(student: nn.Module, tensors: dict[str, Tensor], path: str | Path) -> None:
    """Give a network its weights.

    Raises:
        SettingsError: If they do not fit, naming the file they are from.
    """
    try:
        student.load_state_dict(tensors)
    except RuntimeError as fault:
        words = str(fault).splitlines()[-1].strip()
        raise SettingsError(
            "weights", f"{path} does not fit ({words})", "names and shapes must be the network's", MEND
        ) from None


def load_network(
    path: str | Path, kind: str, key: str, settings: Callable[[Any], Settings], make: Callable[[Settings], Trained]
) -> Trained:
    """A network in evaluation mode from a weight file.

    Args:
        path: The file.
        kind: Whose weights they must be.
        key: What the network's settings are called in the file's header.
        settings: Reads them.
        make: The network of such settings.

    Raises:
        SettingsError: If the file is missing, damaged, foreign, holds bad settings, or its weights do not fit them.
        MissingExtra: If safetensors is not installed.
    """
    tensors, header = load_weights(path, kind)
    try:
        network = make(settings(header.get(key)))
    except SettingsError as fault:
        raise fault.within(f"weights: {path}: {key}") from None
    fill(network, to_floats(tensors), path)
    return network.eval()


def save_checkpoint(
    path: Path, student: nn.Module, average: dict[str, Tensor], optimiser: torch.optim.Optimizer, header: dict[str, Any]
) -> None:
    """Write everything that changes in training; ``header`` holds the settings and the step."""
    tensors = {f"model/{name}": value for name, value in student.state_dict().items()}
    tensors |= {f"average/{name}": value for name, value in average.items()}
    for index, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser/{index}/{name}": torch.as_tensor(value) for name, value in moments.items()}
    # clones: tensors that share memory cannot stand in one safetensors file
    save_weights(path, {name: value.clone() for name, value in tensors.items()}, CHECKPOINT_KIND, header)


def restore(
    path: Path, student: nn.Module, average: dict[str, Tensor], optimiser: torch.optim.Optimizer, settings: dict[str, Any]
) -> int:
    """Fill student, average and optimiser from a checkpoint of a run on the same ``settings``; its step.

    Raises:
        SettingsError: If the file is not a checkpoint of such a run.
    """
    tensors, header = load_weights(path, CHECKPOINT_KIND)
    if header.get("training") != settings:
        raise SettingsError("out", f"holds a run on other settings ({path})", "a run goes on with its own settings", MEND)
    groups: dict[str, dict[str, Tensor]] = {"model": {}, "average": {}, "optimiser": {}}
    for name, value in tensors.items():
        group, _, rest = name.partition("/")
        groups[group][rest] = value
    fill(student, groups["model"], path)
    for name, value in groups["average"].items():
        average[name].copy_(value)
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in groups["optimiser"].items():
        index, _, moment = name.partition("/")
        state.setdefault(int(index), {})[moment] = value
    optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
    return int(header["step"])
