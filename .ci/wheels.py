"""Whether every supported platform and Python gets all that is pinned as wheels: `make wheels` prints a table for the docs.

The index is asked, nothing is installed. What markers leave out is named in the table; exits with 1 where a wheel is missing.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCKS = ("demo", "dev")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")

#: By the name for people, the name for uv, with the oldest C library that every wheel can do with: Debian 10 has glibc 2.28;
#: Ubuntu 22.04 has 2.35, which openvino wants on arm64.
PLATFORMS = {
    "Linux, x86-64": "x86_64-manylinux_2_28",
    "Linux, arm64": "aarch64-manylinux_2_35",
    "macOS 14, arm64": "aarch64-apple-darwin",
    "Windows, x86-64": "x86_64-pc-windows-msvc",
}

#: The oldest macOS that torch can do with.
MACOS = {"MACOSX_DEPLOYMENT_TARGET": "14.0"}


def name_of(requirement: str) -> str:
    """The package that a line of requirements is about."""
    return re.split(r"[^\w.-]", requirement, maxsplit=1)[0].lower()


def optional_packages() -> set[str]:
    """What extras bring and dev.txt pins, with markers or without."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = {name_of(line) for line in (ROOT / "requirements/dev.txt").read_text(encoding="utf-8").splitlines()}
    return {name_of(wish) for extra in project["optional-dependencies"].values() for wish in extra} & pinned


def wheels(platform: str, python: str, nowhere: Path, requirements: Path, *options: str) -> tuple[set[str], str]:
    """The packages that would be installed from wheels alone, or what is wrong.

    ``uv pip install --dry-run`` for another platform resolves by its markers and tags; an empty folder as the target keeps it
    from looking at what is installed here.
    """
    command = [
        sys.executable, "-m", "uv", "pip", "install", "--dry-run", "--target", str(nowhere),
        "--python-platform", platform, "--python-version", python, "--only-binary", ":all:", *options, "-r", str(requirements),
    ]  # fmt: skip
    done = subprocess.run(command, env=os.environ | MACOS, capture_output=True, text=True)
    return set(re.findall(r"^ \+ ([\w.-]+)==", done.stderr, re.MULTILINE)), done.stderr if done.returncode else ""


def main(torch: str) -> int:
    """Print the table; the status is 1 where a wheel is missing."""
    optional, faults = optional_packages(), []
    print(f"| platform | {' | '.join(PYTHONS)} |", "---".join("|" * (len(PYTHONS) + 2)), sep="\n")
    with tempfile.TemporaryDirectory() as folder:
        nowhere, beside = Path(folder) / "nowhere", Path(folder) / "torch.txt"
        beside.write_text(torch + "\n", encoding="utf-8")
        for title, platform in PLATFORMS.items():
            cells = []
            for python in PYTHONS:
                ask = partial(wheels, platform, python, nowhere)
                asked = [ask(ROOT / f"requirements/{lock}.txt", "--require-hashes") for lock in LOCKS] + [ask(beside)]
                wrong = [fault for _, fault in asked if fault]
                faults += [f"{title}, Python {python}: {fault}" for fault in wrong]
                missing = sorted(optional - set().union(*(names for names, _ in asked)))
                cells.append("fails" if wrong else f"all but {', '.join(missing)}" if missing else "all")
            print(f"| {title} | {' | '.join(cells)} |", flush=True)
    print(*faults, sep="\n", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
