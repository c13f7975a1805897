"""What is installed: the pinned files agree with pyproject.toml, and what is missing is asked for by the right extra."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from flockopt import MissingExtra
from tests.conftest import missing_skips

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SOURCES = [path for package in ("flockopt", "learned", "sim", "benchmarks") for path in sorted((ROOT / package).rglob("*.py"))]


def pins(purpose):
    """Package and version, with the marker if there is one, of each pinned package."""
    text = (ROOT / f"requirements/{purpose}.txt").read_text(encoding="utf-8")
    return {line.rstrip(" \\") for line in text.splitlines() if line[:1].isalnum()}


def name_of(requirement):
    return re.match(r"[\w.-]+", requirement)[0].lower()


def names(requirements):
    return {name_of(requirement) for requirement in requirements}


def test_the_demo_installs_a_part_of_what_the_tests_do():
    assert pins("demo")
    assert pins("demo") < pins("dev")


@pytest.mark.parametrize("purpose", ["demo", "dev"])
def test_every_python_gets_the_same_versions(purpose):
    assert len(pins(purpose)) == len(names(pins(purpose)))


def test_what_the_demo_can_do_without_is_not_in_it():
    optional = names(line for name, extra in PROJECT["optional-dependencies"].items() if name != "show" for line in extra)
    assert not names(pins("demo")) & optional
    assert names(PROJECT["dependencies"]) < names(pins("demo"))


def test_torch_is_pinned_alike_everywhere():
    (wanted,) = {line for extra in PROJECT["optional-dependencies"].values() for line in extra if name_of(line) == "torch"}
    assert f"TORCH := {wanted}\n" in (ROOT / "Makefile").read_text(encoding="utf-8")


@pytest.mark.parametrize("extra", sorted(set(PROJECT["optional-dependencies"]) - {"all", "cluster"}))
def test_every_extra_is_pinned(extra):
    assert names(PROJECT["optional-dependencies"][extra]) - {"torch"} <= names(pins("dev"))


def asked_for(text):
    """Package and extra of each optional package that a module asks for."""
    yield from re.findall(r'MissingExtra\("([^"]+)", "([^"]+)"\)', text)
    for module, extra, package in re.findall(r'\brequire\("([^"]+)", extra="([^"]+)"(?:, package="([^"]+)")?\)', text):
        yield package or module.partition(".")[0], extra


def test_a_missing_package_comes_with_the_extra_that_is_named():
    named = {pair for path in SOURCES for pair in asked_for(path.read_text(encoding="utf-8"))}
    assert {extra for _, extra in named} == set(PROJECT["optional-dependencies"]) - {"all"}
    for package, extra in named:
        assert package.lower() in names(PROJECT["optional-dependencies"][extra]), package


def test_tests_of_missing_packages_are_skipped_and_no_others():
    with pytest.raises(pytest.skip.Exception, match=r"no-such-package.*flockopt\[sim\]"), missing_skips():
        raise MissingExtra("no-such-package", "sim")
    with pytest.raises(MissingExtra, match="numpy"), missing_skips():
        raise MissingExtra("numpy", "sim")
