"""The networks of a method, and their weight files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor, nn

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.networks.weight_files import load_weights
from learned.teacher.actors.magnnet import MagnnetActor
from learned.teacher.actors.policy import TeacherActor

__all__ = ["load_actor", "make_actor", "set_tensors"]

ACTORS: dict[str, type[TeacherActor] | type[MagnnetActor]] = {"teacher": TeacherActor, "magnnet": MagnnetActor}


def make_actor(method: str, width: int) -> TeacherActor | MagnnetActor:
    """An actor with new weights, drawn from torch's own random numbers."""
    return ACTORS[method](width)


def load_actor(method: str, path: str | Path) -> TeacherActor | MagnnetActor:
    """An actor with the weights of a file, ready to be asked.

    Raises:
        SettingsError: If the file is missing, damaged, foreign or does not fit the method.
    """
    tensors, settings = load_weights(path, method)
    width = checks.integer(SettingsError, f"weights: {path}: width", settings.get("width"), least=2)
    actor = make_actor(method, width)
    set_tensors(actor, tensors, str(path))
    return actor.eval().requires_grad_(False)


def set_tensors(network: nn.Module, tensors: dict[str, Tensor], source: str) -> None:
    """Give a network its weights.

    Raises:
        SettingsError: If a tensor is missing, unknown or of another shape; ``source`` names the file.
    """
    expected: dict[str, Any] = network.state_dict()
    shapes = {name: tuple(tensor.shape) for name, tensor in expected.items()}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if wrong := sorted(name for name in {*shapes, *found} if shapes.get(name) != found.get(name)):
        value = f"{source} holds {wrong[0]!r} of shape {found.get(wrong[0])}"
        raise SettingsError("weights", value, f"must be {shapes.get(wrong[0])}", "name weights of this version")
    network.load_state_dict(tensors)
