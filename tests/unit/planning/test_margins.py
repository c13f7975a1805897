"""Room for tracking errors: kept where the scene leaves it, given up where it does not, and never at a certificate's cost."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import Box, Bundles, Cylinder, Plan, SettingsError, Sphere, compute_travel, generate, plan
from flockopt.geometry.distances import distances
from flockopt.planning.margins import margins, roomier
from flockopt.planning.planners import Planner, Proposal
from flockopt.travel import START
from tests.flights import drone, in_order, make_scene

MARGIN_M = 0.03

#: What a task or start keeps from an obstacle at least, in these scenes: radius and clearance.
NEED_M = 0.22

PILLAR = Cylinder("pillar", (5, 5, 2), 0.6, 4.0)
WALL = Box("wall", (5, 5, 2), (0.4, 3.0, 4.0), 0.5)
ROCK = Sphere("rock", (5, 5, 1.2), 0.5)


def widened(scene, bundles=None, clearance_m=MARGIN_M, separation_m=2 * MARGIN_M):
    return roomier(scene, compute_travel(scene), bundles or in_order(scene), clearance_m, separation_m)[0]


def margin_of(made, clause):
    return next(one.margin for one in made.certificate.clauses if one.name == clause)


@pytest.mark.parametrize("obstacle", [PILLAR, WALL, ROCK], ids=lambda one: one.shape)
def test_plans_keep_the_margin_where_there_is_room(obstacle):
    scene = make_scene([drone(0, (1, 5, 1.2))], [(9, 5, 1.2)], (obstacle,))
    bare, kept = (plan(scene, planner="classical", tracking_margin_m=margin_m) for margin_m in (0.0, MARGIN_M))
    assert bare.status == kept.status == "certified"
    assert kept.scene_sha256 == scene.sha256
    assert margin_of(bare, "clearance") < MARGIN_M
    assert margin_of(kept, "clearance") >= MARGIN_M
    assert kept.cost.travel == bare.cost.travel
    assert kept.cost.lower_bound == bare.cost.lower_bound


def test_drones_that_meet_keep_twice_the_margin():
    scene = make_scene([drone(0, (1, 5, 1)), drone(1, (5, 1, 1))], [(9, 5, 1), (5, 9, 1)])
    bundles = Bundles(((0,), (1,)))
    assert widened(scene, bundles).separation == pytest.approx(0.46)
    bare, kept = (plan(scene, planner="classical", tracking_margin_m=margin_m) for margin_m in (0.0, MARGIN_M))
    assert kept.status == "certified"
    assert margin_of(kept, "separation") >= min(2 * MARGIN_M, margin_of(bare, "separation"))


def test_obstacles_grow_by_half_of_the_room_that_places_leave():
    near = (5.6 + NEED_M + 0.01, 5.0, 1.0)
    scene = make_scene([drone(0, (1, 1, 1))], [near, (1, 9, 1)], (PILLAR, Sphere("rock", (2, 5, 1), 0.4)))
    grown = widened(scene)
    assert grown.obstacles[0].radius == pytest.approx(0.605)
    assert grown.obstacles[0].height == pytest.approx(4.01)
    assert grown.obstacles[1].radius == pytest.approx(0.43)
    np.testing.assert_allclose(grown.bounds.lower, MARGIN_M)


def test_a_task_right_at_the_clearance_is_still_served():
    scene = make_scene([drone(0, (1, 1, 1))], [(5.6 + NEED_M, 5.0, 1.0)], (PILLAR,))
    assert widened(scene).obstacles == scene.obstacles
    assert plan(scene, tracking_margin_m=MARGIN_M).status == "certified"


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_a_place_beside_a_corner_stays_clear_of_the_grown_box(yaw):
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    beside = turn @ (np.array([0.2, 1.5, 1.0]) + (NEED_M + 0.02) / np.sqrt(3))
    wall = Box("wall", (5, 5, 1), (0.4, 3.0, 2.0), yaw)
    scene = make_scene([drone(0, (1, 1, 1))], [tuple(np.array(wall.center) + beside)], (wall,))
    grown = widened(scene)
    assert grown.obstacles != scene.obstacles
    assert distances(grown.obstacle_table, scene.task_positions).min() >= NEED_M


def test_a_gap_that_the_margin_would_close_stays_open():
    """Between two walls that leave 2 x 0.22 m and a little; around them it is far."""
    half = NEED_M + 0.015
    walls = (
        Box("south", (5, 2.5 - half / 2, 2), (0.4, 5.0 - half, 4.0)),
        Box("north", (5, 7.5 + half / 2, 2), (0.4, 5.0 - half, 4.0)),
    )
    far = Sphere("far", (2, 8, 1), 0.4)
    scene = make_scene([drone(0, (3, 5, 1))], [(7, 5, 1)], (*walls, far))
    grown = widened(scene)
    assert grown.obstacles[:2] == scene.obstacles[:2]
    assert grown.obstacles[2].radius == pytest.approx(0.43)
    assert plan(scene, tracking_margin_m=MARGIN_M).status == "certified"


def test_starts_limit_the_separation_and_ellipsoids_grow_as_a_whole():
    scene = make_scene([drone(0, (1, 1, 1)), drone(1, (1.42, 1, 1))], [])
    assert widened(scene, Bundles(((), ()))).separation == pytest.approx(0.41)
    tall = make_scene([drone(0, (1, 1, 1)), drone(1, (5, 1, 1))], [], separation_z=0.8)
    grown = widened(tall, Bundles(((), ())))
    assert grown.widest_axes == pytest.approx((0.46, 0.46, 0.92))
    directions = np.random.default_rng(0).normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    surface = directions / np.linalg.norm(directions / tall.widest_axes, axis=1)[:, None]
    moved = surface[:, None] + 2 * MARGIN_M * directions[None, :50]
    assert (np.linalg.norm(moved / grown.widest_axes, axis=-1) <= 1.0 + 1e-9).all()


def test_parked_drones_that_stand_closer_than_the_margin_do_not_cost_the_certificate():
    """The second drone cannot move, and the first one's task is right at the separation from it."""
    scene = make_scene([drone(0, (1, 1, 1)), drone(1, (5, 5, 1), capacity=0)], [(5.41, 5, 1)])
    made = plan(scene, tracking_margin_m=MARGIN_M)
    assert made.status == "certified"
    assert 0.0 <= margin_of(made, "separation") < 2 * MARGIN_M


def test_faults_of_the_allocation_do_not_take_the_margin():
    """A planner that leaves a task out: no other margin would serve it."""
    scene = make_scene([drone(0, (1, 5, 1.2))], [(9, 5, 1.2), (9, 8, 1)], (PILLAR,))
    forgetful = Planner(lambda request: Proposal(Bundles(((0,),), ((1, "forgotten"),))), "forgetful")
    made = plan(scene, planner=forgetful, tracking_margin_m=MARGIN_M)
    assert [clause.name for clause in made.certificate.failed] == ["coverage"]
    assert margin_of(made, "clearance") >= MARGIN_M


def test_no_margin_changes_nothing():
    scene = generate("forest", drones=3, tasks=6, seed=1)
    travel = compute_travel(scene)
    assert roomier(scene, travel, in_order(scene), 0.0, 0.0) == (scene, travel)
    bare, zero = plan(scene), plan(scene, tracking_margin_m=0.0)
    assert {**bare.to_dict(), "timing": {}} == {**zero.to_dict(), "timing": {}}
    assert margins(0.0) == ((0.0, 0.0),)
    assert margins(0.1)[-1] == (0.0, 0.0)


@pytest.mark.parametrize("value", [-0.01, float("nan"), float("inf"), "wide", True])
def test_bad_margins_are_named(value):
    with pytest.raises(SettingsError, match=r"^tracking_margin_m is "):
        plan(make_scene([drone(0, (1, 1, 1))], []), tracking_margin_m=value)


def test_the_command_line_takes_a_margin(flockopt, tmp_path):
    scene = make_scene([drone(0, (1, 5, 1.2))], [(9, 5, 1.2)], (PILLAR,))
    scene.save(tmp_path / "scene.json")
    command = ["plan", tmp_path / "scene.json", "-o", tmp_path / "plan.json", "--quiet", "--tracking-margin"]
    assert flockopt(*command, "0.03")[0] == 0
    assert margin_of(Plan.load(tmp_path / "plan.json"), "clearance") >= MARGIN_M
    status, _, err = flockopt(*command, "-0.1")
    assert status == 2
    assert "--tracking-margin is '-0.1'" in err


def test_travel_of_routes_holds_the_routes_own_legs():
    scene = generate("rooms", drones=3, tasks=6, seed=0)
    routes = ((0, 3), (), (5, 1, 2))
    whole, part = compute_travel(scene), compute_travel(scene, routes=routes)
    for index, route in enumerate(routes):
        assert part.route_length(index, route) == pytest.approx(whole.route_length(index, route), rel=1e-3)
        for leg in zip((START, *route), route, strict=False):
            np.testing.assert_allclose(part.path(index, *leg)[[0, -1]], whole.path(index, *leg)[[0, -1]])
    assert np.isinf(part.task_task[0, 3, 4])


def test_flown_positions_keep_what_the_scene_asks():
    """In this scene flights without a margin have undercut the clearance."""
    pytest.importorskip("pybullet", reason="pybullet comes with the extra 'sim'")
    from sim.mission.execute import execute

    scene = generate("rooms", drones=10, tasks=20, seed=6)
    bare, kept = (
        execute(scene, plan(scene, planner="classical", seed=6, bound="fast", tracking_margin_m=margin_m))
        for margin_m in (0.0, MARGIN_M)
    )
    assert bare.measures.min_clearance < scene.clearance + 0.01
    assert kept.measures.min_clearance > scene.clearance + 0.5 * MARGIN_M
    assert kept.measures.min_separation > scene.separation
    assert kept.measures.max_tracking_error < MARGIN_M
