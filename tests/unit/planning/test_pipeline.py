"""The pipeline: settings, planners, statuses, and the same answer for the same seed."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import Bundles, SettingsError, Task, generate, plan
from flockopt.planning.planners import PLANNERS, Proposal, default_planner, planner_names
from tests.flights import drone, make_scene


@pytest.fixture(scope="module")
def scene():
    return generate("forest", drones=4, tasks=9, seed=2)


def test_the_same_seed_gives_the_same_plan(scene):
    first, second = plan(scene, seed=3), plan(scene, seed=3)
    assert first.status == "certified"
    assert first.routes == second.routes
    assert first.cost == second.cost
    for name, flight in first.flights.items():
        np.testing.assert_array_equal(flight.curve.coefficients, second.flights[name].curve.coefficients)


def test_stages_are_reported_and_timed(scene):
    seen = []
    result = plan(scene, planner="classical", progress=lambda stage, fraction: seen.append((stage, fraction)))
    assert [stage for stage, _ in seen] == ["travel", "allocate", "bound", "decode", "deconflict", "certify"]
    assert [fraction for _, fraction in seen] == sorted(fraction for _, fraction in seen)
    assert {"allocate", "generate", "decode", "certify", "total"} <= result.timing.keys()


def test_the_hybrid_plans_where_nobody_is_named_and_it_is_ready(scene, monkeypatch):
    student = pytest.importorskip("learned.student.planner")
    pytest.importorskip("torch", reason="torch comes with the extra 'learned'")
    assert default_planner() == plan(scene).planner == "hybrid"
    with monkeypatch.context() as patch:
        patch.setattr(student, "WEIGHTS", student.WEIGHTS.with_name("missing.safetensors"))
        assert default_planner() == plan(scene).planner == "classical"
    monkeypatch.setattr(student, "find_spec", lambda name: None if name == "torch" else name)
    assert default_planner() == "classical"


def test_a_time_limit_that_is_used_up_still_ends_in_a_plan(scene):
    assert plan(scene, time_limit_s=1e-6).status == "certified"


def test_tighter_bounds_are_closer(scene):
    bounds = [plan(scene, bound=name).cost.lower_bound for name in ("fast", "tight", "exact")]
    assert bounds == sorted(bounds)
    assert bounds[0] < bounds[2]


def test_no_tasks_and_too_little_capacity():
    idle = plan(make_scene([drone(0, (1, 1, 1))], []))
    assert (idle.status, idle.flights, idle.cost.gap) == ("certified", {}, 0.0)
    short = plan(make_scene([drone(0, (1, 1, 1), 1)], [(5, 5, 1), Task("heavy", (6, 6, 1), demand=3)]))
    assert short.status == "infeasible"
    assert "heavy" in short.reason
    assert short.flights == {}


def test_another_planner_is_judged_like_our_own(scene, monkeypatch):
    def forgetful(request):
        return Proposal(Bundles(((0,), (1,), (2,), (3,))), timing={"generate": 0.5})

    monkeypatch.setitem(PLANNERS, "forgetful", forgetful)
    assert "forgetful" in planner_names()
    result = plan(scene, planner="forgetful")
    assert result.status == "uncertified"
    assert "coverage" in [clause.name for clause in result.certificate.failed]
    assert result.timing["generate"] == 0.5


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"planner": "oracle"}, "planner is 'oracle'; must be one of .*classical"),
        ({"time_limit_s": 0.0}, "time_limit_s is 0.0"),
        ({"time_limit_s": float("nan")}, "time_limit_s is nan"),
        ({"seed": -1}, "seed is -1"),
        ({"bound": "wild"}, "bound is 'wild'; must be one of fast, tight, exact"),
    ],
)
def test_bad_settings_are_named(scene, settings: dict, words: str):
    with pytest.raises(SettingsError, match=words):
        plan(scene, **settings)
