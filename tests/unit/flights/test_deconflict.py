"""Planted conflicts: resolved, or named as unresolvable."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest

from flockopt import Bounds, Box, Bundles, Scene, decode, deconflict, plan
from flockopt.flights.apart.schedule import meeting_steps, schedule
from tests.flights import check_flights, drone, make_scene, worst_separation


def resolve(scene: Scene, routes: tuple):
    bundles = Bundles(routes)
    flights = decode(scene, bundles)
    before = worst_separation(scene, flights)
    result = deconflict(scene, bundles, flights)
    check_flights(scene, result.flights)
    return before, worst_separation(scene, result.flights), result


def wall_with_door() -> tuple:
    return (Box("left", (5, 2.2, 2), (0.4, 4.4, 4)), Box("right", (5, 7.8, 2), (0.4, 4.4, 4)))


def tunnel() -> tuple:
    sides = (Box("a", (5, 4.35, 2), (6, 0.6, 4)), Box("b", (5, 5.65, 2), (6, 0.6, 4)))
    return (*sides, Box("roof", (5, 5, 3.2), (6, 0.8, 1.6)), Box("floor", (5, 5, 0.4), (6, 0.8, 0.8)))


PLANTED = {
    "exchange of places": (make_scene([drone(0, (1, 5, 1)), drone(1, (9, 5, 1))], [(9, 5, 1), (1, 5, 1)]), ((0,), (1,))),
    "a grounded drone on the way": (make_scene([drone(0, (1, 5, 1)), drone(1, (5, 5, 1), 0)], [(9, 5, 1)]), ((0,), ())),
    "an idle drone at a task": (make_scene([drone(0, (1, 5, 1)), drone(1, (5, 5, 1))], [(5.2, 5, 1)]), ((0,), ())),
    "two last tasks side by side": (
        make_scene([drone(0, (1, 5, 1)), drone(1, (9, 5, 1))], [(5, 5, 1), (5.1, 5, 1)]),
        ((0,), (1,)),
    ),
    "an end on another's way": (
        make_scene([drone(0, (1, 5, 1)), drone(1, (9, 5, 1))], [(5, 5, 1), (3, 5, 1), (7, 5, 1)]),
        ((0,), (1, 2)),
    ),
    "eight through one door": (
        make_scene([drone(i, (1.5, 1 + i, 1.0)) for i in range(8)], [(8.5, 1 + i, 1.0) for i in range(8)], wall_with_door()),
        tuple((i,) for i in range(8)),
    ),
    "head-on in a tunnel": (
        make_scene([drone(0, (1, 5, 1.6)), drone(1, (9, 5, 1.6))], [(9, 3, 1.6), (1, 3, 1.6)], tunnel()),
        ((0,), (1,)),
    ),
}


@pytest.mark.parametrize("name", PLANTED)
def test_planted_conflicts_are_resolved(name: str):
    before, after, result = resolve(*PLANTED[name])
    assert before < 0.0
    assert result.unresolved == ()
    assert after >= 0.0


def test_an_ellipsoid_keeps_drones_out_of_each_others_downwash():
    drones, tasks = [drone(0, (1, 5, 1)), drone(1, (9, 5, 1.9))], [(9, 5, 1), (1, 5, 1.9)]
    assert worst_separation(make_scene(drones, tasks), decode(make_scene(drones, tasks), Bundles(((0,), (1,))))) > 0.0
    before, after, result = resolve(make_scene(drones, tasks, separation_z=1.0), ((0,), (1,)))
    assert before < 0.0 <= after
    assert result.unresolved == ()


#: No wider than a drone needs, and each has its task where the other one starts.
TUBE = make_scene([drone(0, (1, 5, 1)), drone(1, (9, 5, 1))], [(9, 5, 1), (1, 5, 1)]).replace(
    bounds=Bounds((0.9, 4.9, 0.9), (9.1, 5.1, 1.1))
)


def test_what_cannot_be_resolved_is_named_with_pair_and_time():
    _, after, result = resolve(TUBE, ((0,), (1,)))
    assert after < 0.0
    (conflict,) = result.unresolved
    assert conflict.drones == ("d0", "d1")
    assert "'d0' and 'd1' come too close at" in str(conflict)
    assert conflict.time > 1.0


def test_flights_that_meet_nobody_are_left_alone():
    scene = make_scene([drone(0, (1, 1, 1)), drone(1, (1, 9, 1))], [(9, 1, 1), (9, 9, 1)])
    bundles = Bundles(((0,), (1,)))
    flights = decode(scene, bundles)
    assert deconflict(scene, bundles, flights).flights is flights


def circle_swap(count: int):
    angles = np.arange(count) * 2 * np.pi / count
    spots = np.column_stack([5 + 4 * np.cos(angles), 5 + 4 * np.sin(angles), np.full(count, 1.5)])
    drones = [drone(i, tuple(spot)) for i, spot in enumerate(spots)]
    return make_scene(drones, [tuple(spots[(i + count // 2) % count]) for i in range(count)]), tuple((i,) for i in range(count))


def test_all_changing_places_across_a_circle():
    before, after, result = resolve(*circle_swap(6))
    assert before < 0.0 <= after
    assert result.unresolved == ()


def test_without_the_scheduling_model_drones_wait_one_after_another(monkeypatch):
    monkeypatch.setitem(sys.modules, "ortools.sat.python.cp_model", None)
    before, after, result = resolve(*PLANTED["eight through one door"])
    assert before < 0.0 <= after
    assert result.unresolved == ()


def test_the_schedule_has_least_makespan():
    scene, routes = PLANTED["eight through one door"]
    flights = list(decode(scene, Bundles(routes)).values())
    curves = [(flight.curve.breakpoints, flight.curve.coefficients) for flight in flights][:3]
    axes, step, most = scene.axes_between(0, 1), 0.2, 8
    delays = schedule(curves, [True] * 3, scene.axes_between, step, most)
    assert delays is not None
    tables = {(a, b): meeting_steps(*curves[a], *curves[b], axes, step, most) for a, b in itertools.combinations(range(3), 2)}
    best = min(
        max(curve[0][-1] + step * k for curve, k in zip(curves, steps, strict=True))
        for steps in itertools.product(range(most + 1), repeat=3)
        if not any(tables[a, b][most + steps[a] - steps[b]] for a, b in tables)
    )
    assert max(curve[0][-1] + delay for curve, delay in zip(curves, delays, strict=True)) <= best + step


def test_no_delay_helps_two_drones_that_change_places_in_a_tube():
    flights = decode(TUBE, Bundles(((0,), (1,))))
    curves = [(flight.curve.breakpoints, flight.curve.coefficients) for flight in flights.values()]
    assert schedule(curves, [True, True], TUBE.axes_between, 0.2, 20) is None


def test_a_drone_that_only_comes_to_a_halt_has_no_way_around():
    scene = make_scene([drone(0, (1, 5, 1), velocity=(2.0, 0.0, 0.0)), drone(1, (1.5, 5, 1))], [])
    bundles = Bundles(((), ()))
    result = deconflict(scene, bundles, decode(scene, bundles))
    assert [conflict.drones for conflict in result.unresolved] == [("d0", "d1")]


def crossing(*pairs, tasks=(), **fields):
    """Drones with ends and no tasks, by start and end, in an empty room."""
    drones = [drone(index, start, end=end) for index, (start, end) in enumerate(pairs)]
    return make_scene(drones, list(tasks), **fields)


@pytest.mark.parametrize(
    "scene",
    [
        crossing(((4, 5, 1), (6, 5, 1)), ((6, 5, 1), (4, 5, 1))),
        crossing(((4, 5, 1), (6, 5, 1)), ((6, 5, 1), (4, 5, 1)), ((5, 4, 1), (5, 6, 1)), ((5, 6, 1), (5, 4, 1))),
    ],
    ids=["two", "four"],
)
def test_drones_with_ends_and_no_tasks_give_way_too(scene):
    assert plan(scene, planner="classical").status == "certified"


def test_a_drone_that_has_served_moves_off_for_one_that_comes():
    """The second drone's task is the first one's end."""
    scene = make_scene([drone(0, (2, 5, 1), capacity=0, end=(5, 5, 1)), drone(1, (8, 5, 1))], [(5, 5, 1)])
    assert plan(scene, planner="classical").status == "certified"
