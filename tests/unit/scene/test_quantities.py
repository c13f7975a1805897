"""Numbers beyond what floating point bears, and in units that were not meant, are refused by name."""

from __future__ import annotations

import dataclasses
import math
import warnings

import pytest

from flockopt import Bounds, Box, Cylinder, Drone, Origin, Scene, SceneError, Task, plan

DRONE = Drone("d", (1.0, 1.0, 1.0), 2, 0.1, 2.0, 4.0, 30.0)


@pytest.mark.parametrize("field", ["radius", "max_speed", "max_acceleration", "max_jerk"])
@pytest.mark.parametrize("value", [1e300, 1e-300, 2e9, 1e-7])
def test_drones_are_neither_huge_nor_tiny(field, value):
    with pytest.raises(SceneError, match=f"^{field} is .*another unit"):
        dataclasses.replace(DRONE, **{field: value})


@pytest.mark.parametrize("field", ["max_distance", "mass"])
def test_what_a_drone_can_do_has_an_end(field):
    with pytest.raises(SceneError, match=f"^{field} is 1e\\+300"):
        dataclasses.replace(DRONE, **{field: 1e300})


@pytest.mark.parametrize("field", ["clearance", "separation"])
def test_room_to_be_kept_is_none_or_can_be_measured(scene, field):
    assert getattr(scene.replace(**{field: 0.0}), field) == 0.0
    for value in (1e300, 1e-300):
        with pytest.raises(SceneError, match=f"^{field} is "):
            scene.replace(**{field: value})


def test_service_has_an_end():
    assert Task("t", (1, 1, 1), service_time=86400.0).service_time == 86400.0
    with pytest.raises(SceneError, match=r"service_time is 1e\+300.*in seconds"):
        Task("t", (1, 1, 1), service_time=1e300)


def test_coordinates_have_an_end():
    with pytest.raises(SceneError, match=r"start\[1\] is 1.1e\+08; .*rounding decides; subtract an offset"):
        dataclasses.replace(DRONE, start=(0.0, 1.1e8, 0.0))
    with pytest.raises(SceneError, match=r"upper\[0\] is 1e\+300"):
        Bounds((0, 0, 0), (1e300, 1, 1))
    with pytest.raises(SceneError, match=r"upper\[2\] is 2e\+06; must be at most 1e\+06 m.*narrow"):
        Bounds((0, 0, 0), (1, 1, 2e6))
    with pytest.raises(SceneError, match=r"center\[0\] is 1e\+300"):
        Cylinder("c", (1e300, 0, 0), 1.0, 1.0)
    with pytest.raises(SceneError, match=r"size\[2\] is 1e\+300"):
        Box("b", (0, 0, 0), (1, 1, 1e300))


@pytest.mark.parametrize("degrees", [90.0, -90.0, 360.0, 7.0])
def test_degrees_are_not_taken_for_radians(degrees):
    with pytest.raises(SceneError, match=r"yaw is .*\[-2 pi, 2 pi\]; give it in radians; did you mean degrees\?"):
        Box("b", (0, 0, 0), (1, 1, 1), degrees)
    with pytest.raises(SceneError, match=r"heading is .*did you mean degrees\?"):
        Origin(50.0, 4.0, 0.0, degrees)


def test_once_around_is_an_angle():
    for radians in (2 * math.pi, -2 * math.pi, 6.284, 0.0):
        assert Box("b", (0, 0, 0), (1, 1, 1), radians).yaw == Origin(50.0, 4.0, 0.0, radians).heading == radians


def test_a_tilt_in_degrees_is_told():
    with pytest.raises(SceneError, match=r"max_tilt is 30; must be < pi / 2 radians; .*did you mean degrees\?"):
        dataclasses.replace(DRONE, max_tilt=30.0)


@pytest.mark.parametrize("value", [2**53 + 1, 10**18, 1e300, 10**400])
def test_demands_and_capacities_are_exact(value):
    with pytest.raises(SceneError, match="demand is "):
        Task("t", (1, 1, 1), demand=value)
    with pytest.raises(SceneError, match="capacity is "):
        dataclasses.replace(DRONE, capacity=value)


def test_sums_of_demands_and_capacities_are_exact(scene):
    tasks = tuple(dataclasses.replace(task, demand=2**52) for task in scene.tasks)
    with pytest.raises(SceneError, match=rf"tasks have a demand of {3 * 2**52} in all; .*2\*\*53"):
        scene.replace(tasks=tasks)
    with pytest.raises(SceneError, match="drones have a capacity of"):
        scene.replace(drones=tuple(dataclasses.replace(drone, capacity=2**53) for drone in scene.drones))


def test_the_largest_numbers_are_planned_without_a_warning(scene):
    first, second = scene.drones
    drones = (dataclasses.replace(first, capacity=2**53 - 2), dataclasses.replace(second, capacity=2))
    tasks = (dataclasses.replace(scene.tasks[0], demand=2**53 - 2), *scene.tasks[1:])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = plan(scene.replace(drones=drones, tasks=tasks), planner="classical")
    assert made.status == "certified"
    assert made.routes["d0"] == ("t0",)


@pytest.mark.parametrize("bound", [1e9, 1e-6])
def test_the_limits_themselves_are_planned(bound):
    drone = dataclasses.replace(DRONE, max_speed=bound, max_acceleration=bound, max_jerk=bound)
    scene = Scene("limits", Bounds((0, 0, 0), (9, 9, 9)), (drone,), (Task("t", (8, 8, 8)), Task("u", (1, 8, 1))))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plan(scene, planner="classical").status == "certified"


def test_long_services_keep_their_order():
    tasks = tuple(Task(f"t{j}", (1.0 + j, 8.0, 1.0), service_time=1e6) for j in range(7))
    scene = Scene("long", Bounds((0, 0, 0), (9, 9, 9)), (dataclasses.replace(DRONE, capacity=7),), tasks)
    assert plan(scene, planner="classical").status == "certified"
