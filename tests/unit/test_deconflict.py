"""Planted conflicts: resolved, or named as unresolvable."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from flockopt import Box, Bundles, Scene, decode, deconflict
from flockopt.continuous import least_separation, parked
from test_decode import check_flights, drone, make_scene


def worst_separation(scene: Scene, flights: dict) -> float:
    """Least margin of any pair over all time, metres."""
    curves = [
        (flights[record.id].curve.breakpoints, flights[record.id].curve.coefficients)
        if record.id in flights
        else parked(np.array(record.start))
        for record in scene.drones
    ]
    end = max(curve[0][-1] for curve in curves)
    axes = np.array(scene.separation_axes)
    return min(least_separation(*a, *b, axes, 0.0, end, 1e-6)[0] for a, b in itertools.combinations(curves, 2))


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
    "two last tasks side by side": (make_scene([drone(0, (1, 5, 1)), drone(1, (9, 5, 1))], [(5, 5, 1), (5.1, 5, 1)]), ((0,), (1,))),
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


def test_what_cannot_be_resolved_is_named_with_pair_and_time():
    ends = [drone(0, (1, 5, 1), end=(5, 5, 1)), drone(1, (9, 5, 1), end=(5.1, 5, 1))]
    _, after, result = resolve(make_scene(ends, [(3, 5, 1), (7, 5, 1)]), ((0,), (1,)))
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
