"""Every code fence of README and docs runs, and prints what is printed beside it."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.dotted_names import MODULES, dangling, exists, runs, texts

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Pages that say how things are now, and not how they were.
MANUALS = [*PAGES, *sorted((ROOT / "learned/weights").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)")

#: Commands that set a machine up; a test does not run them.
SETTING_UP = ("git", "cd", "pip")


def fences(page):
    """(language, code, the ``text`` fence right after it or None) for every fence of a page."""
    found = [(match.group(1), match.group(2), match.end()) for match in FENCE.finditer(page.read_text(encoding="utf-8"))]
    text = page.read_text(encoding="utf-8")
    for index, (language, code, end) in enumerate(found):
        expected = None
        if index + 1 < len(found) and found[index + 1][0] == "text":
            between = text[end : text.index("```text", end)]
            expected = found[index + 1][1] if between.strip() == "" else None
        yield language, code, expected


def cases(*languages):
    for page in PAGES:
        for number, (language, code, expected) in enumerate(fences(page)):
            if language in languages:
                yield pytest.param(code, expected, id=f"{page.stem}-{number}")


def run(command, folder):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.fixture
def workplace(tmp_path):
    """A folder that looks like the repository's root to an example, where it may write."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "out").mkdir()
    return tmp_path


@pytest.mark.parametrize(("code", "expected"), [*cases("python")])
def test_python_examples(workplace, code, expected):
    done = run([sys.executable, "-c", code], workplace)
    assert done.returncode == 0, done.stderr
    if expected is not None:
        assert done.stdout.split() == expected.split()


@pytest.mark.parametrize(("code", "expected"), [*cases("bash", "sh", "console")])
def test_shell_examples(workplace, code, expected):
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if not words or words[0] in SETTING_UP:
            continue
        if words[0] == "make":
            targets = (ROOT / "Makefile").read_text(encoding="utf-8")
            assert all(re.search(rf"^{target}:", targets, re.MULTILINE) for target in words[1:]), line
            continue
        if words[0] == "flockopt":
            words = ["python", "-m", *words]
        assert words[:2] == ["python", "-m"], f"{line}: this test does not know how to run it"
        arguments = [words[2], "--help"] if words[2].startswith("benchmarks.") else words[2:]  # benchmarks take long
        done = run([sys.executable, "-m", *arguments], workplace)
        assert done.returncode == 0, f"{line}: {done.stderr}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name} points to {target}"


@pytest.mark.parametrize("page", [page for page in MANUALS if page.name != "results.md"], ids=lambda page: page.stem)
def test_pages_name_what_there_is(page):
    text = page.read_text(encoding="utf-8")
    assert dangling(text) == set()


@pytest.mark.parametrize("package", ["flockopt", "learned", "sim", "benchmarks", "tests", "docs", "examples"])
def test_sources_name_what_there_is(package):
    paths = set((ROOT / package).rglob("*.py")) - {Path(__file__)}  # this file names what there is not, below
    found = {path.relative_to(ROOT): set().union(*map(dangling, texts(path))) for path in paths}
    assert {path: names for path, names in found.items() if names} == {}


def test_a_name_that_leads_nowhere_would_be_seen():
    assert exists("flockopt.certify")
    assert exists("flockopt.scene.Scene.sha256")
    assert exists("sim.mission.mission.Mission.state")
    assert not any(map(exists, ["flockopt.nothing", "flockopt.plan.nothing", "flockopt.scene.Scene.nothing", "nothing.plan"]))
    assert runs("sim.live")
    assert not runs("sim.live.page")
    for module in (module for module in MODULES if "." in module):  # each as it would stand after a move
        assert dangling(f"see `{module}_moved`, or run python -m {module}_moved") == {f"{module}_moved", f"-m {module}_moved"}
    assert dangling("from sim.mission import mission, orders, nothing") == {"sim.mission.nothing"}
    assert dangling("see sim/mission.py, and format flockopt.plan/1") == {"sim/mission.py"}


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_the_readme_has_an_example_with_its_output():
    examples = [(code, expected) for language, code, expected in fences(ROOT / "README.md") if language == "python"]
    assert examples
    assert examples[0][1] is not None
    assert "certified" in examples[0][1]
