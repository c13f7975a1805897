"""What the tests share: small scenes, and the command line run in this process."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import pytest

from flockopt import Scene

ROOT = Path(__file__).resolve().parent.parent

#: Two drones, three tasks, a pillar between them, as the JSON object of a scene file.
TWO_DRONES = json.loads((ROOT / "examples/scenes/two-drones.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def root():
    """The repository's root directory."""
    return ROOT


@pytest.fixture
def two_drones():
    """A JSON scene object that a test may change."""
    return copy.deepcopy(TWO_DRONES)


@pytest.fixture(scope="session")
def scene():
    """The same scene, made once."""
    return Scene.from_dict(TWO_DRONES)


@pytest.fixture
def flockopt(capsys):
    """Run the command line in this process: ``status, out, err = flockopt("plan", ...)``."""
    from flockopt.cli.main import main

    def run(*arguments):
        status = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run
