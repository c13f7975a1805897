"""The student's planners: certified plans, choice of tries, fallbacks, NaN kept out, errors that name what is missing."""

from __future__ import annotations

import dataclasses
import hashlib
import subprocess
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt import Bundles, MissingExtra, SettingsError, generate, plan  # noqa: E402 - torch may be missing
from flockopt.flights.smoothing.stages import squared_jerk  # noqa: E402
from flockopt.flights.waypoints import anchored_legs, leg_clear  # noqa: E402
from flockopt.geometry.polylines import thinned  # noqa: E402
from flockopt.planning.planners import PLANNERS, Planner, Proposal, Request  # noqa: E402
from flockopt.travel.travel import straight_travel  # noqa: E402
from learned.student import planner  # noqa: E402
from learned.student.inference import draw, task_probabilities  # noqa: E402
from learned.student.planner import HYBRID, LEARNED, LEARNED_PAPER, TIMED_WEIGHTS, WEIGHTS, shipped_student  # noqa: E402
from learned.student.pulling import pulled_samples  # noqa: E402
from learned.student.scenes.batch import collate  # noqa: E402
from learned.student.scenes.examples import example, unassigned  # noqa: E402
from tests.student_scenes import random_routes, taught_example, tiny_student  # noqa: E402


@pytest.fixture(scope="module")
def forest():
    return generate("forest", drones=4, tasks=9, seed=2)


@pytest.fixture(autouse=True)
def planners(monkeypatch):
    """A tiny network in place of the shipped one."""
    student = tiny_student("small")
    monkeypatch.setattr(planner, "shipped_student", lambda path: student)
    return student


@pytest.mark.parametrize("proposer", [LEARNED, HYBRID], ids=lambda proposer: proposer.name)
@pytest.mark.parametrize("family", ["forest", "rooms"])
def test_plans_are_certified_and_the_same_each_time(proposer, family):
    scene = generate(family, drones=3, tasks=6, seed=1)
    first, second = (plan(scene, planner=proposer, seed=4) for _ in range(2))
    assert first.status == "certified"
    assert {"head", "refine", "generate"} <= first.timing.keys()
    assert first.routes == second.routes and first.cost == second.cost


@pytest.mark.parametrize("seed", range(4))
def test_hybrid_is_never_worse_than_classical(seed):
    scene = generate("city", drones=4, tasks=10, seed=seed)
    assert plan(scene, planner=HYBRID).cost.travel <= plan(scene).cost.travel + 1e-9


def test_the_hybrid_keeps_to_a_time_limit(forest, monkeypatch):
    plan(forest, planner=HYBRID)  # so that the networks are loaded
    limits, search = [], planner.refine_bundles
    monkeypatch.setattr(planner, "refine_bundles", lambda *a, **k: limits.append(k["time_limit_s"]) or search(*a, **k))
    result = plan(forest, planner=HYBRID, time_limit_s=3.0)
    assert result.status == "certified"
    assert result.cost.travel <= plan(forest, planner="classical").cost.travel + 1e-9
    assert len(limits) == 2 and min(limits) > 0.0 and limits[0] > 4.0 * limits[1] and sum(limits) < 3.0


@pytest.mark.parametrize("family", ["forest", "rooms"])
def test_the_hybrid_smooths_its_fleet(family):
    scene = generate(family, drones=4, tasks=10, seed=3)
    plain, smooth = plan(scene, planner="classical"), plan(scene, planner=HYBRID)
    jerk = [
        sum(squared_jerk(flight.curve.breakpoints, flight.curve.coefficients) for flight in one.flights.values())
        for one in (plain, smooth)
    ]
    assert smooth.status == "certified" and "smooth" in smooth.timing
    assert smooth.cost.makespan <= plain.cost.makespan + 1e-9
    assert jerk[1] < 0.8 * jerk[0]


@pytest.mark.parametrize("config", ["small", "paper"])
def test_nan_from_the_network_never_reaches_a_plan(config, forest, monkeypatch):
    student = tiny_student(config)
    for parameter in student.parameters():
        parameter.data.fill_(torch.nan)
    monkeypatch.setattr(planner, "shipped_student", lambda path: student)
    base = example(forest, random_routes(forest, 1))
    (drawing,) = draw(student, [base])
    assert np.array_equal(drawing.samples, base.straight)
    for name in ("learned", "hybrid"):
        result = plan(forest, planner=name)
        assert result.status == "certified"
        assert all(np.isfinite(flight.curve.coefficients).all() for flight in result.flights.values())


def test_tries_are_chosen_leg_by_leg(planners):
    one = taught_example("forest", drones=6, tasks=12, seed=1)
    (drawing,) = draw(planners, [one], tries=3, seed=5)
    assert drawing.num_drawn == one.blocked.any(axis=1).sum() > 0
    for drone, route in enumerate(one.routes):
        legs = anchored_legs(one.scene, drone, route, drawing.samples[drone]) if route else []
        assert drawing.clear[drone] == all(
            leg_clear(one.scene, drone, thinned(leg, 0.3 * one.scene.radii[drone])) for leg in legs
        )
        if not one.blocked[drone].any():
            assert np.array_equal(drawing.samples[drone], one.straight[drone])


def test_pulling_taut_keeps_ways_clear_and_shortens_them():
    one = taught_example("forest", drones=6, tasks=12, seed=1)
    pulled = pulled_samples(one, one.target)
    for drone in np.flatnonzero(one.blocked.any(axis=1)):
        before, after = (anchored_legs(one.scene, drone, one.routes[drone], samples[drone]) for samples in (one.target, pulled))
        lengths = [sum(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum() for leg in legs) for legs in (before, after)]
        assert lengths[1] < lengths[0]
        assert all(leg_clear(one.scene, drone, leg) for leg in after)
        for places in (one.leg_begin[drone], one.leg_end[drone]):
            assert np.array_equal(pulled[drone, places], one.straight[drone, places])


def test_batches_of_scenes_are_drawn_as_one_by_one():
    student = tiny_student("small")
    examples = [taught_example("forest", drones=3, tasks=6, seed=seed) for seed in range(3)]
    alone = [task_probabilities(student, collate([one]))[0] for one in examples]
    together = task_probabilities(student, collate(examples))
    assert all(np.allclose(a, b, atol=1e-6) for a, b in zip(alone, together, strict=True))
    (before_bundles,) = task_probabilities(student, collate([unassigned(examples[0].scene)]))
    assert np.array_equal(before_bundles, alone[0])
    assert [drawing.samples.shape for drawing in draw(student, examples)] == [(3, 64, 3)] * 3


def test_plans_of_a_batch_are_those_of_its_scenes(forest):
    student = tiny_student("small")
    scenes = [forest, generate("forest", drones=1, tasks=66, seed=0), generate("rooms", drones=3, tasks=6, seed=1)]
    scenes += [dataclasses.replace(forest, tasks=()), generate("forest", drones=6, tasks=12, seed=1)]
    requests = [Request(scene, straight_travel(scene), None, seed) for seed, scene in enumerate(scenes)]
    for request, (bundles, drawing, timing) in zip(requests, planner.drawn_plans(student, requests), strict=True):
        alone_bundles, alone, _ = planner.drawn_plan(student, request)
        assert bundles == alone_bundles and timing.keys() == {"head", "refine", "generate"}
        assert (drawing is None) == (alone is None)
        if drawing is not None:
            assert np.allclose(drawing.samples, alone.samples, atol=1e-4) and np.array_equal(drawing.clear, alone.clear)
    assert planner.drawn_plans(student, []) == []


def test_each_scene_is_drawn_by_its_own_seed(planners, monkeypatch):
    one = taught_example("forest", drones=6, tasks=12, seed=1)
    together = draw(planners, [one, one], tries=1, seed=[0, 5])
    alone = [draw(planners, [one], tries=1, seed=seed)[0] for seed in (0, 5)]
    assert not np.array_equal(together[0].samples, together[1].samples)
    assert all(np.allclose(a.samples, b.samples, atol=1e-4) for a, b in zip(together, alone, strict=True))
    seen = []
    monkeypatch.setattr("learned.student.inference.draw", lambda *a, **k: seen.append(k["seed"]) or draw(*a, **k))
    planner.drawn_plans(planners, [Request(one.scene, straight_travel(one.scene), None, seed) for seed in (3, 8)])
    assert seen == [[3, 8]]


def test_later_tries_may_take_other_steps_than_the_first(planners):
    one = taught_example("forest", drones=6, tasks=12, seed=1)
    first, pair, later = (
        draw(planners, [one], steps=steps, tries=tries) for steps, tries in ((1, 1), ((1, 2), 1), ((2, 1), 1))
    )
    assert np.array_equal(first[0].samples, pair[0].samples)
    assert not np.array_equal(first[0].samples, later[0].samples)


def test_a_drone_with_more_legs_than_samples_flies_the_paths(planners):
    scene = generate("forest", drones=1, tasks=66, seed=0)
    result = plan(scene, planner=LEARNED)
    assert result.status == "certified"


def test_no_tasks_and_too_little_capacity(forest):
    assert plan(dataclasses.replace(forest, tasks=()), planner=HYBRID).status == "certified"
    grounded = dataclasses.replace(forest, drones=tuple(dataclasses.replace(drone, capacity=1) for drone in forest.drones))
    for proposer in (LEARNED, HYBRID):
        assert plan(grounded, planner=proposer).status == "infeasible"


def test_drones_that_only_fly_home_are_drawn_too(planners):
    one = taught_example("forest", drones=6, tasks=12, seed=1)
    drone = int(np.flatnonzero(one.blocked.any(axis=1))[0])
    leg = np.flatnonzero(one.blocked[drone])[-1]
    begin, end = (one.straight[drone, places[drone, leg]] for places in (one.leg_begin, one.leg_end))
    home = dataclasses.replace(one.scene.drones[drone], start=tuple(begin), end=tuple(end))
    scene = dataclasses.replace(one.scene, drones=(home,), tasks=())
    (drawing,) = draw(planners, [example(scene, [()])])
    assert drawing.num_drawn == 1 and np.allclose(drawing.samples[0, [0, -1]], [begin, end])


def test_the_classical_planner_steps_in_where_a_clause_fails(forest):
    def forgetful(request):
        return Proposal(Bundles(((0,), (1,), (2,), (3,))), otherwise=PLANNERS["classical"])

    result = plan(forest, planner=Planner(forgetful))
    assert result.status == "certified" and result.planner == "forgetful"
    assert result.timing["fallback"] > 0.0
    assert result.cost.travel == plan(forest).cost.travel


def test_missing_and_damaged_weights_are_named(tmp_path):
    with pytest.raises(SettingsError, match="nothing"):
        shipped_student(tmp_path / "nothing.safetensors")
    (tmp_path / "damaged.safetensors").write_bytes(b"not weights")
    with pytest.raises(SettingsError, match="damaged"):
        shipped_student(tmp_path / "damaged.safetensors")


@pytest.mark.parametrize("proposer", [LEARNED, LEARNED_PAPER, HYBRID], ids=lambda proposer: proposer.name)
def test_an_unknown_backend_is_named(proposer):
    scene = generate("forest", drones=2, tasks=3, seed=0)
    with pytest.raises(SettingsError, match="backend is 'abacus'; must be one of torch, torch-eager"):
        plan(scene, planner=proposer, backend="abacus")


def test_a_plan_says_which_weights_and_which_backend_steered_it(forest):
    made = plan(forest, planner=HYBRID, backend="torch-eager")
    assert made.settings["backend"] == "torch-eager"
    assert made.settings["weights"] == hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()
    assert made.settings["smoother_weights"] == hashlib.sha256(TIMED_WEIGHTS.read_bytes()).hexdigest()
    assert plan(forest, planner=LEARNED).settings["backend"] == "torch"


def test_planners_without_networks_refuse_a_backend(forest):
    with pytest.raises(SettingsError, match="backend is 'torch'; planner 'classical' has no networks"):
        plan(forest, planner="classical", backend="torch")


def test_missing_torch_is_named(tmp_path, monkeypatch):
    for name in [
        name for name in sys.modules if name.startswith(("learned.student.checkpoint", "learned.student.network.model"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtra, match="torch is not installed"):
        shipped_student(tmp_path / "other.safetensors")


def test_registering_the_planners_loads_no_torch():
    code = "import learned.student.planner, sys; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"


def test_a_time_limit_too_short_for_the_networks_is_kept_without_them():
    scene = generate("forest", drones=4, tasks=9, seed=2)
    made = plan(scene, planner="hybrid", time_limit_s=0.1)
    assert made.status == "certified"
    assert made.settings["networks"] == "none: the time limit is too short for them"
    plan(scene, planner="hybrid")
    assert "networks" not in plan(scene, planner="hybrid", time_limit_s=3.0).settings
