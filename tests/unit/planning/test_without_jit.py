"""A plan made, saved and verified with numba switched off, as in a debugger that steps through it."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from flockopt import Box, Cylinder, Scene, Sphere, plan
from tests.flights import drone, make_scene

SCRIPT = """
import sys
import numba
from flockopt import Plan, Scene, certify, plan
assert numba.config.DISABLE_JIT
scene, made = Scene.load(sys.argv[1]), sys.argv[2]
plan(scene, planner="classical").save(made)
assert certify(scene, Plan.load(made)).certified
"""


def small_scene() -> Scene:
    """A straight way through each kind of obstacle, and two drones."""
    obstacles = (
        Box("box", (3, 1, 1), (0.6, 0.8, 2), 0.3),
        Cylinder("pillar", (3, 5, 1.5), 0.4, 3),
        Sphere("ball", (5, 3.2, 1.2), 0.4),
    )
    return make_scene([drone(0, (1, 1, 1)), drone(1, (1, 5, 1), 2)], [(5, 1, 1), (5, 5, 1), (5.5, 2.2, 1.5)], obstacles)


@pytest.fixture(scope="module")
def without_jit(tmp_path_factory):
    folder = tmp_path_factory.mktemp("without")
    small_scene().save(folder / "scene.json")
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", SCRIPT, folder / "scene.json", folder / "plan.json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "plan.json").read_text())


def test_the_plan_is_the_one_that_is_made_with_it(without_jit):
    made = plan(small_scene(), planner="classical")
    assert without_jit["status"] == made.status == "certified"
    assert {name: tuple(route) for name, route in without_jit["routes"].items()} == made.routes
    for figure in ("travel", "length", "lower_bound", "makespan"):
        assert without_jit["cost"][figure] == pytest.approx(getattr(made.cost, figure), rel=1e-9)
    for mine, theirs in zip(without_jit["certificate"]["clauses"], made.certificate.clauses, strict=True):
        assert mine["name"] == theirs.name
        assert mine["margin"] == pytest.approx(theirs.margin, abs=1e-6)
