"""From bundles to flights: exact anchors, limits, clearance, mending."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import Box, Bundles, Cylinder, SettingsError, Task, compute_travel, decode, generate, refine_bundles
from flockopt.geometry.continuous import least_clearance
from tests.flights import check_flights, drone, in_order, make_scene


@pytest.mark.parametrize("family", ["forest", "corridor", "warehouse", "rooms", "city"])
def test_flights_through_family_scenes_are_clear_and_within_limits(family: str):
    scene = generate(family, drones=4, tasks=12, seed=5)
    bundles = refine_bundles(scene)
    flights = decode(scene, bundles)
    check_flights(scene, flights)
    for record, route in zip(scene.drones, bundles, strict=True):
        visits = flights[record.id].visits if record.id in flights else ()
        assert [visit.task for visit in visits] == [scene.tasks[j].id for j in route]
    assert max(flight.curve.num_pieces for flight in flights.values()) <= 31


def test_samples_steer_the_way_and_anchors_stay_exact():
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 1, 1)])
    arc = np.linspace([1, 1, 1], [9, 1, 1], 64)
    arc[:, 1] += 3 * np.sin(np.linspace(0, np.pi, 64))
    straight = decode(scene, in_order(scene))["d0"]
    bent = decode(scene, in_order(scene), arc[None])["d0"]
    check_flights(scene, {"d0": bent})
    middle = bent.curve(bent.curve.duration / 2)
    assert middle[1] > 3.0
    assert bent.curve.length > straight.curve.length + 1.0


def test_samples_through_an_obstacle_are_replaced_by_a_clear_way():
    pillar = Cylinder("pillar", (5, 1, 2), 0.8, 4.0)
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 1, 1), (9, 9, 1)], (pillar,))
    line = np.vstack([np.linspace([1, 1, 1], [9, 1, 1], 32), np.linspace([9, 1, 1], [9, 9, 1], 32)])
    check_flights(scene, decode(scene, in_order(scene), line[None]))


def test_service_time_is_held():
    scene = make_scene(
        [drone(0, (1, 1, 1))], [Task("t0", (4, 1, 1), service_time=1.5), Task("t1", (8, 1, 1), service_time=0.5)]
    )
    flight = decode(scene, in_order(scene))["d0"]
    first, last = flight.visits
    np.testing.assert_allclose(flight.curve(first.time + np.linspace(0, 1.5, 9)), np.tile([4, 1, 1], (9, 1)), atol=1e-9)
    assert flight.curve.end_time == pytest.approx(last.time + 0.5)


def test_two_tasks_at_one_point_are_served_one_after_another():
    scene = make_scene(
        [drone(0, (1, 1, 1))], [Task("t0", (4, 1, 1), service_time=1.0), Task("t1", (4, 1, 1), service_time=1.0)]
    )
    flight = decode(scene, in_order(scene))["d0"]
    assert flight.visits[1].time == pytest.approx(flight.visits[0].time + 1.0)


def test_a_task_at_the_start_is_served_without_moving():
    scene = make_scene([drone(0, (1, 1, 1))], [Task("t0", (1, 1, 1), service_time=0.4)])
    flight = decode(scene, in_order(scene))["d0"]
    assert flight.curve.length == 0.0
    assert flight.curve.duration == pytest.approx(0.4)


def test_ends_are_reached_and_idle_drones_stay():
    scene = make_scene([drone(0, (1, 1, 1), end=(1, 9, 1)), drone(1, (3, 1, 1), end="start"), drone(2, (5, 1, 1))], [(9, 9, 1)])
    flights = decode(scene, Bundles(((), (0,), ())))
    np.testing.assert_allclose(flights["d0"].curve(99.0), [1, 9, 1])
    np.testing.assert_allclose(flights["d1"].curve(99.0), [3, 1, 1], atol=1e-9)
    assert "d2" not in flights


def test_a_moving_start_is_continued():
    moving = drone(0, (2, 2, 1), velocity=(1.0, 0.5, 0.0), acceleration=(0.5, 0.0, 0.0))
    scene = make_scene([moving], [(8, 8, 2)])
    curve = decode(scene, in_order(scene))["d0"].curve
    np.testing.assert_allclose(curve(0.0, 1), moving.velocity)
    np.testing.assert_allclose(curve(0.0, 2), moving.acceleration)


def test_a_task_beside_a_wall_is_reached_without_touching_it():
    walls = (Box("low", (5, 5, 2), (0.2, 6, 4)), Box("side", (7, 7.9, 2), (4, 0.2, 4)))
    scene = make_scene([drone(0, (4.5, 9.5, 1))], [(5.33, 7.57, 1), (4.67, 2.2, 1), (5.33, 2.3, 1)], walls)
    flights = decode(scene, in_order(scene))
    check_flights(scene, flights)
    curve = flights["d0"].curve
    assert least_clearance(scene.free_space(0.22), curve.breakpoints, curve.coefficients, 1e-6)[0] >= -1e-6


def test_a_short_leash_keeps_to_the_shortest_way():
    scene = make_scene([drone(0, (1, 1, 1))], [(5, 1, 1), (5, 5, 1), (1, 5, 1)])
    loose = decode(scene, in_order(scene))["d0"].curve.length
    travel = compute_travel(scene).route_length(0, (0, 1, 2))
    assert loose > travel + 0.1
    leashed = make_scene([drone(0, (1, 1, 1), max_distance=travel + 0.01)], [(5, 1, 1), (5, 5, 1), (1, 5, 1)])
    assert decode(leashed, in_order(leashed))["d0"].curve.length <= travel + 0.01


@pytest.mark.parametrize(
    ("samples", "field"),
    [
        (np.zeros((2, 64, 3)), "samples"),
        (np.zeros((1, 64, 2)), "samples"),
        (np.full((1, 64, 3), np.nan), r"samples\[0\]\[0\]\[0\] is nan"),
    ],
)
def test_bad_samples_are_named(samples: np.ndarray, field: str):
    scene = make_scene([drone(0, (1, 1, 1))], [(5, 1, 1)])
    with pytest.raises(SettingsError, match=field):
        decode(scene, in_order(scene), samples)


def test_an_unknown_law_and_a_foreign_fleet_are_named():
    scene = make_scene([drone(0, (1, 1, 1))], [(5, 1, 1)])
    with pytest.raises(SettingsError, match=r"law is 'warp'.*fly-through"):
        decode(scene, in_order(scene), law="warp")
    with pytest.raises(SettingsError, match="bundles hold 2"):
        decode(scene, Bundles(((0,), ())))


def test_a_long_route_fits_the_trajectory_memory():
    rng = np.random.default_rng(2)
    scene = make_scene([drone(0, (1, 1, 1), 20)], [tuple(point) for point in rng.uniform([1, 1, 1], [9, 9, 3], (20, 3))])
    flights = decode(scene, in_order(scene))
    assert flights["d0"].curve.num_pieces <= 31
    check_flights(scene, flights)


def test_a_leg_without_a_way_is_named():
    walls = (Box("wall", (5, 5, 2), (0.4, 10, 4)),)
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 1, 1)], walls)
    with pytest.raises(SettingsError, match=r"bundles\[0\].*leg 0"):
        decode(scene, in_order(scene))
