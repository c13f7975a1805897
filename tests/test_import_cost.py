"""`import flockopt` is light: what it costs, and what it must not load."""

from __future__ import annotations

import subprocess
import sys

import pytest

import flockopt

HEAVY = (
    "casadi", "clarabel", "cvxpy", "highspy", "joblib", "llvmlite", "matplotlib", "numba", "ortools", "pandas", "pybullet",
    "ruckig", "scipy", "torch", "viser",
)  # fmt: skip


def in_new_process(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def best_seconds(module, repeats=3):
    code = f"import time; t = time.perf_counter(); import {module}; print(time.perf_counter() - t)"
    return min(float(in_new_process(code)[0]) for _ in range(repeats))


@pytest.mark.parametrize("statement", ["import flockopt", "from flockopt import Scene, SceneError", "import flockopt.cli.main"])
def test_nothing_heavy_is_loaded(statement):
    loaded = in_new_process(f"{statement}\nimport sys\nprint(*sys.modules)")
    assert "flockopt" in loaded
    assert not {name.split(".")[0] for name in loaded} & set(HEAVY)


def test_it_costs_little_beside_numpy():
    assert best_seconds("flockopt") < 0.5 * best_seconds("numpy") + 0.05


def test_every_public_name_is_there():
    for name in flockopt.__all__:
        value = getattr(flockopt, name)
        assert name == "__version__" or callable(value), name
    assert set(flockopt.__all__) <= set(dir(flockopt))
    with pytest.raises(AttributeError, match="nonsense"):
        flockopt.nonsense  # noqa: B018


def test_a_function_stays_in_view_whatever_is_loaded():
    """No module bears the name of a public function, so that loading one cannot hide it."""
    code = (
        "import flockopt, flockopt.planning.pipeline, flockopt.certificate.judge, flockopt.cli.main\nfrom flockopt import plan"
    )
    code += "\nprint(callable(plan), *(callable(getattr(flockopt, name)) for name in ('plan', 'certify', 'show', 'export')))"
    assert in_new_process(code) == ["True"] * 5
    assert not {f"flockopt.{name}" for name in flockopt.__all__} & set(sys.modules)


def test_the_type_checkers_see_the_same_names():
    """The imports under TYPE_CHECKING and the table of homes are two lists of the same names."""
    import ast
    from pathlib import Path

    tree = ast.parse(Path(flockopt.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == flockopt._HOME_OF
    assert {*seen, "__version__"} == set(flockopt.__all__)
