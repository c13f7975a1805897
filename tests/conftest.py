"""What the tests share: small scenes, the command line run in this process, and what becomes of tests of missing packages."""

from __future__ import annotations

import copy
import json
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from flockopt import MissingExtra, Scene

with suppress(ImportError):  # a machine that only plans has no hypothesis
    from hypothesis import settings

    settings.register_profile("repeatable", derandomize=True)  # a change fails for what it changes, not for its luck
    settings.load_profile("repeatable")

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


@contextmanager
def missing_skips():
    """Skip a test that asks for an optional package which is not installed, with the reason; an installed one must be found."""
    try:
        yield
    except MissingExtra as missing:
        try:
            version(missing.package)
        except PackageNotFoundError:
            pytest.skip(str(missing))
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    with missing_skips():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    with missing_skips():
        return (yield)
