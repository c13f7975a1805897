"""Weight files of the network of timed flights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from learned.networks.checkpoint import in_bfloat16, load_network
from learned.networks.weight_files import save_weights
from learned.smoother.model import TimedNetwork
from learned.smoother.settings import TimedNetworkSettings

__all__ = ["KIND", "load_timed", "save_timed"]

KIND = "timed-student"


def save_timed(path: str | Path, weights: dict[str, Tensor], settings: TimedNetworkSettings, notes: dict[str, Any]) -> None:
    """Write weights for inference, in bfloat16; ``notes`` say how they came about."""
    save_weights(path, in_bfloat16(weights), KIND, {"network": settings.to_dict(), "notes": notes})


def load_timed(path: str | Path) -> TimedNetwork:
    """A network in evaluation mode from a file of `save_timed`.

    Raises:
        SettingsError: If the file is missing, damaged, foreign, or its weights do not fit its settings.
        MissingExtra: If torch or safetensors is not installed.
    """
    return load_network(path, KIND, "network", TimedNetworkSettings.from_dict, TimedNetwork)
