"""Weight files of the network of timed flights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from flockopt.errors import SettingsError
from learned.student.timed_model import TimedNetwork
from learned.student.timed_settings import TimedNetworkSettings
from learned.weight_files import MEND, load_weights, save_weights

__all__ = ["KIND", "load_timed", "save_timed"]

KIND = "timed-student"


def save_timed(path: str | Path, weights: dict[str, Tensor], settings: TimedNetworkSettings, notes: dict[str, Any]) -> None:
    """Write weights for inference, in bfloat16; ``notes`` say how they came about."""
    half = {name: value.to(torch.bfloat16) if name != "spread" else value for name, value in weights.items()}
    save_weights(path, half, KIND, {"network": settings.to_dict(), "notes": notes})


def load_timed(path: str | Path) -> TimedNetwork:
    """A network in evaluation mode from a file of `save_timed`.

    Raises:
        SettingsError: If the file is missing, damaged, foreign, or its weights do not fit its settings.
        MissingExtra: If torch or safetensors is not installed.
    """
    tensors, header = load_weights(path, KIND)
    network = TimedNetwork(TimedNetworkSettings.from_dict(header.get("network", {})))
    try:
        network.load_state_dict({name: value.float() for name, value in tensors.items()})
    except RuntimeError as fault:
        words = str(fault).splitlines()[-1].strip()
        rule = "names and shapes must be the network's"
        raise SettingsError("weights", f"{path} does not fit ({words})", rule, MEND) from None
    return network.eval()
