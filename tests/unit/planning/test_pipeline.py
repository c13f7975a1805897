"""The pipeline: settings, planners, statuses, and the same answer for the same seed."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import time
from types import SimpleNamespace

import numpy as np
import pytest

from flockopt import Bundles, Plan, SettingsError, Task, certify, generate, plan
from flockopt.planning import finish, pipeline, planners
from flockopt.planning.planners import PLANNERS, Planner, Proposal, default_planner, find_planner, planner_names
from flockopt.planning.settings import PlanSettings
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
    assert default_planner().name == plan(scene).planner == "hybrid"
    with monkeypatch.context() as patch:
        patch.setattr(student, "WEIGHTS", student.WEIGHTS.with_name("missing.safetensors"))
        assert default_planner().name == plan(scene).planner == "classical"
    monkeypatch.setattr(student, "find_spec", lambda name: None if name == "torch" else name)
    assert default_planner().name == "classical"


def test_the_hybrid_is_done_no_later_than_the_classical_planner():
    pytest.importorskip("torch", reason="torch comes with the extra 'learned'")
    scene = generate("city", drones=4, tasks=40, seed=2)  # shorter guided bundles would be done 1.4 s later
    hybrid, classical = plan(scene, planner="hybrid"), plan(scene, planner="classical")
    assert hybrid.status == classical.status == "certified"
    assert hybrid.cost.travel <= classical.cost.travel + 1e-9
    assert hybrid.cost.makespan <= classical.cost.makespan + 1e-9


def test_a_time_limit_that_is_used_up_still_ends_in_a_plan(scene):
    assert plan(scene, time_limit_s=1e-6).status == "certified"


@pytest.fixture
def late(monkeypatch):
    """A stage of planning that takes so long that the time limit passes in it."""

    def make(module, name):
        work = getattr(module, name)

        def slow(*arguments, deadline, **keywords):
            time.sleep(max(deadline.left_s, 0.0) + 0.01)
            return work(*arguments, deadline=deadline, **keywords)

        monkeypatch.setattr(module, name, slow)

    return make


@pytest.mark.parametrize(
    ("module", "name", "doing"),
    [
        (pipeline, "compute_travel", "finding ways among obstacles"),
        (finish, "decode", "making flights of the routes"),
        (finish, "deconflict", "keeping drones apart"),
        (finish, "certify", "judging the plan"),
    ],
)
def test_a_plan_that_is_not_finished_in_time_says_what_was_not(scene, late, module, name, doing):
    late(module, name)
    result = plan(scene, planner="classical", time_limit_s=0.3)
    assert result.status == "uncertified"
    assert result.certificate is None
    assert not result.flights
    assert result.reason.startswith(f"out of time while {doing}, after 0.")
    assert bool(result.routes and any(result.routes.values())) == (module is finish)
    assert Plan.from_dict(result.to_dict()) == result


def test_a_margin_that_takes_too_long_is_given_up_for_a_plan_without_one(scene, monkeypatch):
    roomier = finish.roomier

    def slow(*arguments):
        time.sleep(max(arguments[-1].left_s, 0.0) + 0.01)
        arguments[-1].check("making room")
        return roomier(*arguments)

    monkeypatch.setattr(finish, "roomier", slow)
    result = plan(scene, planner="classical", time_limit_s=2.0, tracking_margin_m=0.05)
    assert result.status == "certified"


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


def test_another_planner_is_judged_like_our_own(scene):
    def forgetful(request):
        return Proposal(Bundles(((0,), (1,), (2,), (3,))), timing={"generate": 0.5})

    result = plan(scene, planner=Planner(forgetful))
    assert (result.planner, result.status) == ("forgetful", "uncertified")
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


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"sed": 3}, "sed is an unknown key"),
        ({"smoothing": 1}, "smoothing is 1; must be true or false"),
        ({"tracking_margin_m": -0.1}, "tracking_margin_m is -0.1"),
        ({"paths": "voxel6"}, "paths is 'voxel6'; must be one of any-angle for planner 'classical'"),
        ({"planner": 7}, "planner is 7"),
    ],
)
def test_settings_are_checked_where_they_are_made(scene, settings: dict, words: str):
    with pytest.raises(SettingsError, match=words):
        plan(scene, **{"planner": "classical"} | settings)


def test_settings_are_stored_as_they_are_meant(scene):
    settings = PlanSettings(planner="classical", seed=np.int64(3), time_limit_s=2)
    assert type(settings.seed) is int
    assert type(settings.time_limit_s) is float
    changed = PlanSettings.of(settings, {"seed": 4})
    assert (changed.planner, changed.seed, changed.time_limit_s) == ("classical", 4, 2.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.seed = 5


def test_a_record_and_keywords_give_the_same_plan_and_the_plan_tells_what_steered_it(scene, tmp_path):
    by_record = plan(scene, PlanSettings(planner="classical", seed=3, bound="fast"))
    by_keywords = plan(scene, planner="classical", seed=3, bound="fast")
    assert by_record.cost == by_keywords.cost
    assert by_record.settings == by_keywords.settings
    assert {"seed": 3, "bound": "fast", "paths": "any-angle", "time_limit_s": None}.items() <= by_record.settings.items()
    by_record.save(tmp_path / "plan.json")
    assert Plan.load(tmp_path / "plan.json").settings == by_record.settings


def test_what_a_planner_says_of_itself_is_recorded(scene):
    def told(request):
        bundles = PLANNERS["classical"].propose(request).bundles
        return Proposal(bundles, made_with={"weights": "abc", "backend": str(request.backend)})

    made = plan(scene, planner=Planner(told, takes_backend=True), backend="torch")
    assert (made.settings["weights"], made.settings["backend"]) == ("abc", "torch")


def test_planners_are_found_by_name_and_a_registry_is_not_changed():
    assert {"classical", "exact", "ortools"} <= set(planner_names())
    assert find_planner("classical") is PLANNERS["classical"]
    with pytest.raises(TypeError):
        PLANNERS["mine"] = PLANNERS["classical"]
    with pytest.raises(SettingsError, match="propose is 3; must be a function"):
        Planner(3)
    with pytest.raises(SettingsError, match="name is ''"):
        Planner(functools.partial(print))


def test_an_entry_that_is_no_planner_is_named(monkeypatch):
    entry = SimpleNamespace(name="odd", value="odd.module:thing", load=lambda: print)
    broken = SimpleNamespace(name="broken", value="broken:thing", load=lambda: importlib.import_module("no_such_module"))
    monkeypatch.setattr(planners, "entry_points", lambda group: [entry, broken])
    with pytest.raises(SettingsError, match=r"planner 'odd' names .*odd.module:thing.*; must be a .*Planner"):
        find_planner("odd")
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        find_planner("broken")
    assert default_planner() is PLANNERS["classical"]


def test_the_ready_planner_of_the_highest_rank_plans(monkeypatch):
    def entry(planner):
        return SimpleNamespace(name=planner.name, value="", load=lambda: planner)

    first = Planner(print, "first", rank=30, is_ready=lambda: False)
    second, never = Planner(print, "second", rank=20), Planner(print, "never")
    monkeypatch.setattr(planners, "entry_points", lambda group: [entry(first), entry(second), entry(never)])
    assert default_planner() is second


def test_the_exact_planner_proves_its_optimum_and_the_judge_finds_it_again(scene):
    made = plan(scene, planner="exact")
    assert made.status == "certified"
    assert made.certificate.bound.kind == "optimum"
    assert made.cost.gap == 0.0
    assert made.cost.travel <= plan(scene, planner="classical").cost.travel + 1e-9
    assert certify(scene, made).certified


def test_the_exact_planner_keeps_a_time_limit():
    large = generate("forest", drones=10, tasks=60, seed=0)
    made = plan(large, planner="exact", time_limit_s=4.0)
    assert made.status == "certified"
    assert made.cost.lower_bound <= made.cost.travel


def test_the_routing_solver_is_a_planner(scene):
    pytest.importorskip("ortools", reason="ortools comes with the extra 'solvers'")
    made = plan(scene, planner="ortools", time_limit_s=1.0)
    assert (made.planner, made.status) == ("ortools", "certified")


def test_a_drone_that_cannot_enter_its_way_in_motion_halts_first():
    moving = drone(0, (7.77, 2.05, 3.41), velocity=(0.88, -0.04, 1.61))  # up, with 0.6 m left to the ceiling
    result = plan(make_scene([moving], [(8.46, 1.87, 1.45), (7.97, 1.9, 3.35)]), planner="classical")
    assert result.status == "certified"
    seconds = np.linspace(0.0, 2.0, 2001)
    speeds = np.linalg.norm(result.flights["d0"].curve(seconds, 1), axis=1)
    assert speeds[0] > 1.8 and speeds.min() < 0.01
