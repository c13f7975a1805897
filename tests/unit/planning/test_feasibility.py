"""Drones that never move and stand in others' way for good: infeasible, with both named."""

from __future__ import annotations

import dataclasses

import pytest

from flockopt import plan
from flockopt.planning.feasibility import grounded_in_the_way


def changed(scene, first, second, **changes):
    one, two = scene.drones
    return scene.replace(drones=(dataclasses.replace(one, **first), dataclasses.replace(two, **second)), **changes)


def test_nobody_is_in_the_way(scene):
    assert grounded_in_the_way(scene) is None
    assert grounded_in_the_way(changed(scene, {"capacity": 9}, {"capacity": 0})) is None


def test_an_end_at_a_grounded_drone(scene):
    blocked = changed(scene, {"capacity": 9, "end": (9.0, 1.2, 1.0)}, {"capacity": 0})
    made = plan(blocked, planner="classical")
    assert made.status == "infeasible"
    assert made.reason == (
        "drone 'd0' has its end 0.2 m from where drone 'd1', which has no capacity and no end, stands for good, and "
        "they must keep at least the separation (0.4 m) apart; move one of the two"
    )


def test_a_drone_that_can_leave_is_in_nobodys_way(scene):
    for leaves in ({"capacity": 1}, {"capacity": 0, "end": (2.0, 2.0, 1.0)}, {"capacity": 0, "velocity": (0.0, 0.1, 0.0)}):
        assert grounded_in_the_way(changed(scene, {"capacity": 9, "end": (9.0, 1.2, 1.0)}, leaves)) is None


def test_a_task_at_a_grounded_drone(scene):
    near = dataclasses.replace(scene.tasks[0], position=(9.0, 1.3, 1.0))
    found = grounded_in_the_way(changed(scene, {"capacity": 9}, {"capacity": 0}, tasks=(near, *scene.tasks[1:])))
    assert [task for task, _ in found.unserved] == [0]
    assert "task 't0' is 0.3 m from where drone 'd1'" in found.reason


def test_bodies_count_too_and_a_small_drone_may_pass_where_a_large_one_may_not(scene):
    near = dataclasses.replace(scene.tasks[0], position=(9.0, 1.3, 1.0))
    tasks = (near, *scene.tasks[1:])
    asked = {"tasks": tasks, "separation": 0.0}
    assert grounded_in_the_way(changed(scene, {"capacity": 9}, {"capacity": 0}, **asked)) is None
    found = grounded_in_the_way(changed(scene, {"capacity": 9, "radius": 0.25}, {"capacity": 0}, **asked))
    assert "sum of their radii (0.35 m)" in found.reason


def test_ends_only_just_apart_are_flown(scene):
    tight = changed(scene, {"capacity": 9, "end": (9.0, 1.4, 1.0)}, {"capacity": 0})
    assert plan(tight, planner="classical").status == "certified"
    tight = changed(scene, {"end": (5.0, 2.0, 1.0)}, {"end": (5.4, 2.0, 1.0)})
    assert plan(tight, planner="classical").status == "certified"
    assert plan(tight, planner="classical", tracking_margin_m=0.1).status == "certified"


@pytest.mark.parametrize("planner", ["exact", "ortools"])
def test_every_planner_is_told(scene, planner):
    assert (
        plan(changed(scene, {"capacity": 9, "end": (9.0, 1.2, 1.0)}, {"capacity": 0}), planner=planner).status == "infeasible"
    )
