"""The planners of learned allocators, with allocators that are not learned: paths, reasons, steps."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from flockopt import Bundles, MissingExtra, Plan, SettingsError, compute_travel, generate, plan, refine_bundles
from flockopt.flights.waypoints import leg_clear
from flockopt.scene import Box
from learned.paths.ways import PATHS, find_ways
from learned.teacher import planner
from learned.teacher.planner import bundles_of, control_points
from tests.flights import drone, make_scene


@dataclass
class Allocation:
    routes: tuple
    steps: int


class Allocator:
    """Serves all tasks, or as MAGNNET does one a drone."""

    def __init__(self, method):
        self.is_single = method == "magnnet"
        self.costs = []

    def bundles(self, scenes, travels):
        self.costs.append(travels[0].total([[0]]) if scenes[0].num_tasks else 0.0)
        if self.is_single:
            return [Allocation(tuple((drone,) for drone in range(scenes[0].num_drones)), 10)]
        return [Allocation(refine_bundles(scenes[0], travel=travels[0], iterations=50).routes, 4)]


@pytest.fixture
def allocators(monkeypatch):
    made = {method: Allocator(method) for method in ("magnnet", "magnnet-bundling", "teacher")}
    monkeypatch.setattr(planner, "allocator", made.__getitem__)
    return made


@pytest.fixture(scope="module")
def forest():
    return generate("forest", drones=3, tasks=6, seed=2)


@pytest.mark.parametrize("margin_m", [0.0, 0.03])
@pytest.mark.parametrize("paths", PATHS)
def test_all_paths_are_certified_and_say_their_steps(allocators, tmp_path, forest, paths, margin_m):
    result = plan(forest, planner=planner.TEACHER, paths=paths, tracking_margin_m=margin_m)
    assert result.status == "certified"
    assert result.episode_steps == 4
    assert {"oracle", "policy", "legs"} <= set(result.timing)
    result.save(tmp_path / "plan.json")
    assert Plan.load(tmp_path / "plan.json").episode_steps == 4


def test_staircases_are_flown_and_their_costs_are_what_the_allocator_sees(allocators, forest):
    lengths = [plan(forest, planner=planner.TEACHER, paths=paths, bound="fast").cost.length for paths in PATHS]
    assert lengths[0] < 0.95 * lengths[1] < 0.95 * lengths[2]
    costs = allocators["teacher"].costs
    assert costs[0] < costs[1] < costs[2]


def test_magnnet_names_what_it_leaves_and_can_be_flown_all_the_same(allocators, forest):
    result = plan(forest, planner=planner.MAGNNET)
    assert result.status == "uncertified"
    assert [clause.name for clause in result.certificate.failed] == ["coverage"]
    assert len(result.unserved) == 3
    assert all("magnnet-bundling" in reason for reason in result.unserved.values())
    assert len(result.flights) == 3
    assert result.cost.lower_bound is None
    assert result.cost.gap is None


def test_what_nobody_could_serve_is_infeasible(allocators, forest):
    crowded = make_scene([drone(0, (1, 1, 1), capacity=1)], [(2, 2, 1), (3, 3, 1)])
    result = plan(crowded, planner=planner.TEACHER)
    assert result.status == "infeasible"
    assert "1 too little" in result.reason


def test_a_policy_that_leaves_tasks_has_proven_nothing(forest):
    travel = compute_travel(forest)
    left = bundles_of(forest, travel, ((0, 1), (2,), ()), "teacher")
    assert left.status == "incomplete"
    assert [task for task, _ in left.unserved] == [3, 4, 5]
    assert "left over" in left.unserved[0][1]


def test_what_a_policy_leaves_is_inserted_before_its_bundles_are_refined(allocators, forest, monkeypatch):
    leaves = SimpleNamespace(bundles=lambda scenes, travels: [Allocation(((0, 1), (), ()), 2)])
    monkeypatch.setattr(planner, "allocator", lambda method: leaves)
    result = plan(forest, planner=planner.TEACHER)
    assert result.status == "certified"
    assert result.cost.travel < 1.1 * plan(forest).cost.travel


@pytest.mark.parametrize("paths", PATHS)
def test_control_points_hold_every_corner_and_are_clear(paths):
    scene = generate("rooms", drones=2, tasks=4, seed=1)
    leg = find_ways(scene, paths).leg
    bundles = Bundles(((2, 0), ()))
    samples = control_points(scene, bundles, leg)
    assert len(np.unique(samples[1], axis=0)) == 1
    for task in bundles[0]:
        assert (samples[0] == scene.task_positions[task]).all(axis=1).any()
    np.testing.assert_array_equal(samples[0, -1], scene.task_positions[0])
    assert leg_clear(scene, 0, samples[0])


def test_what_the_grid_does_not_reach_is_reached_any_angle():
    slit = 0.48  # 4 cm wide for these drones: no voxel centre is in it
    walls = (Box("w0", (5, 2.37, 2), (0.2, 4.74, 4)), Box("w1", (5, 4.74 + slit + 2.39, 2), (0.2, 4.78, 4)))
    scene = make_scene([drone(0, (1, 5, 1))], [(9, 5, 1)], walls)
    ways = find_ways(scene, "voxel6")
    assert ways.travel.start_task[0, 0] == pytest.approx(compute_travel(scene).start_task[0, 0])
    assert leg_clear(scene, 0, ways.leg(0, -1, 0))


def test_paths_a_planner_does_not_know_are_refused(scene, allocators):
    with pytest.raises(SettingsError, match="paths is 'voxel6'; must be one of any-angle for planner 'classical'"):
        plan(scene, planner="classical", paths="voxel6")
    with pytest.raises(SettingsError, match="paths is 'tunnel'; must be one of any-angle, voxel26, voxel6"):
        plan(scene, planner=planner.TEACHER, paths="tunnel")
    with pytest.raises(SettingsError, match="paths is 'tunnel'"):
        find_ways(scene, "tunnel")


def test_paths_are_an_option_of_the_command_line(root, flockopt, allocators, tmp_path):
    example = root / "examples/scenes/two-drones.json"
    status, _, error = flockopt("plan", example, "-o", tmp_path / "p.json", "--planner", "classical", "--paths", "tunnel")
    assert (status, error.count("\n"), (tmp_path / "p.json").exists()) == (2, 1, False)
    assert "paths is 'tunnel'; must be one of any-angle for planner 'classical'" in error
    lengths = []
    for paths in ("any-angle", "voxel6"):
        assert flockopt("plan", example, "-o", tmp_path / "p.json", "--planner", "teacher", "--paths", paths)[0] == 0
        lengths.append(Plan.load(tmp_path / "p.json").cost.length)
    assert lengths[0] < 0.95 * lengths[1]


def test_without_torch_the_extra_is_named(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtra, match="torch is not installed; it comes with the extra 'learned'"):
        planner.allocator("teacher")
