"""Jerk-limited profiles along a polyline: limits, smoothness, exact points, few pieces."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from flockopt import Bounds, Box, Bundles, Drone, MissingExtra, Scene, Task, generate
from flockopt.flights import Curve
from flockopt.flights.decode import decode
from flockopt.flights.laws import fly_through
from flockopt.flights.laws.corner_speeds import SHORTEST_PHASE_S, corner_speeds, must_be_simple, peak_speed, ramp_seconds
from flockopt.flights.room import MOST_PIECES
from flockopt.geometry.bernstein import control_points, largest_norm

pytest.importorskip("ruckig", reason="ruckig comes with the extra 'trajectory'")

from flockopt.flights.laws.ruckig_law import fly_polyline

LIMITS = np.array([2.0, 4.0, 30.0])
ZERO = np.zeros(3)


def random_polyline(seed: int):
    rng = np.random.default_rng(seed)
    legs = int(rng.integers(1, 9))
    points = rng.uniform(0, [20, 20, 5], (legs + 1, 3)) * rng.choice([1.0, 0.1, 0.01])
    if seed % 5 == 0 and legs > 1:  # a point on the straight way between its neighbours
        points[1] = 0.3 * points[0] + 0.7 * points[2]
    rest_s = np.where(rng.random(legs + 1) < 0.2, rng.choice([0.0, 0.7]), -1.0)
    rest_s[0], rest_s[-1] = -1.0, 0.0
    return points, rest_s


def fly(points, rest_s, unwanted: int = 0, caps=None):
    caps = np.full(len(points) - 1, LIMITS[0]) if caps is None else caps
    return fly_polyline(points, rest_s, caps, LIMITS, ZERO, ZERO, unwanted)


def largest(curve: Curve, order: int) -> float:
    control = control_points(curve.breakpoints, curve.coefficients, curve.coefficients.shape[2])
    return largest_norm(curve.breakpoints, control, order)[0]


@pytest.mark.parametrize("unwanted", [0, 12, MOST_PIECES])
@pytest.mark.parametrize("seed", range(40))
def test_passes_every_point_within_limits(seed: int, unwanted: int):
    points, rest_s = random_polyline(seed)
    breakpoints, coefficients, times, owners = fly(points, rest_s, unwanted)
    curve = Curve(breakpoints, coefficients)
    np.testing.assert_allclose(curve(times), points, atol=1e-7)
    for order, limit in enumerate(LIMITS, start=1):
        assert largest(curve, order) <= limit * (1 + 1e-6)
    assert len(owners) == curve.num_pieces
    assert (np.diff(owners) >= 0).all()
    assert (np.diff(times) > 0).all()


@pytest.mark.parametrize("seed", range(40))
def test_position_velocity_and_acceleration_are_continuous(seed: int):
    curve = Curve(*fly(*random_polyline(seed))[:2])
    spans = np.diff(curve.breakpoints)
    for order, tolerance in ((0, 1e-9), (1, 1e-8), (2, 1e-6)):
        coefficients = curve._derivatives(order)
        ends = np.einsum("kad,kd->ka", coefficients, spans[:, None] ** np.arange(coefficients.shape[2]))
        np.testing.assert_allclose(ends[:-1], coefficients[1:, :, 0], atol=tolerance)
        if order:
            np.testing.assert_allclose(coefficients[0, :, 0], 0.0, atol=tolerance)
            np.testing.assert_allclose(ends[-1], 0.0, atol=tolerance)


def test_a_straight_leg_is_as_fast_as_can_be():
    curve = Curve(*fly(np.array([[0.0, 0, 1], [9, 0, 1]]), np.array([-1.0, 0]))[:2])
    ramp_s = 2.0 / 4.0 + 4.0 / 30.0
    assert curve.duration == pytest.approx(9 / 2.0 + ramp_s)
    assert curve.num_pieces == 7


def test_corners_are_not_stops():
    points = np.array([[0.0, 0, 1], [6, 0, 1], [6, 6, 1]])
    breakpoints, coefficients, times, _ = fly(points, np.array([-1.0, -1, 0]))
    curve = Curve(breakpoints, coefficients)
    assert np.linalg.norm(curve(times[1], 1)) > 1.2  # the chord of a right-angled turn at 2 m/s


def test_a_capped_corner_is_slow_while_its_legs_are_fast():
    points = np.array([[0.0, 0, 1], [6, 0, 1], [12, 1, 1]])
    breakpoints, coefficients, times, _ = fly(points, np.array([-1.0, -1, 0]), caps=np.array([0.5, 0.5]))
    curve = Curve(breakpoints, coefficients)
    assert np.linalg.norm(curve(times[1], 1)) <= 0.5 + 1e-9
    assert largest(curve, 1) > 1.9
    slow = Curve(*fly_through.fly_polyline(points, np.array([-1.0, -1, 0]), np.array([0.5, 0.5]), LIMITS, ZERO, ZERO, 0)[:2])
    assert curve.duration < 0.4 * slow.duration


def test_rest_holds_still_for_its_time():
    points = np.array([[0.0, 0, 1], [3, 0, 1], [3, 3, 1]])
    breakpoints, coefficients, times, _ = fly(points, np.array([-1.0, 1.5, 0.5]))
    curve = Curve(breakpoints, coefficients)
    np.testing.assert_allclose(curve(times[1] + np.linspace(0, 1.5, 7)), np.tile(points[1], (7, 1)), atol=1e-8)
    assert curve.end_time == pytest.approx(times[2] + 0.5)


def test_unwanted_pieces_are_given_up_and_cost_time():
    points = np.random.default_rng(1).uniform(0, [20, 20, 5], (6, 3))
    rest_s = np.array([-1.0, -1, -1, -1, -1, 0])
    flights = [fly(points, rest_s, unwanted)[0] for unwanted in (0, 12, 20)]
    pieces = [len(breakpoints) - 1 for breakpoints in flights]
    assert pieces[0] > pieces[1] > pieces[2]
    assert pieces[1] <= MOST_PIECES - 12
    assert pieces[2] <= MOST_PIECES - 20
    assert flights[0][-1] < flights[1][-1] < flights[2][-1] < 1.1 * flights[0][-1]


def test_a_moving_start_is_continued():
    velocity, acceleration = np.array([1.0, -0.5, 0.2]), np.array([0.5, 1.0, 0.0])
    points = np.array([[0.0, 0, 1], [4, 1, 1], [8, 0, 1]])
    curve = Curve(*fly_polyline(points, np.array([-1.0, -1, 0]), np.full(2, 2.0), LIMITS, velocity, acceleration)[:2])
    np.testing.assert_allclose(curve(0.0, 1), velocity)
    np.testing.assert_allclose(curve(0.0, 2), acceleration)


@pytest.mark.parametrize("change", [1e-7, 1e-3, 0.1, 0.53, 0.5334, 0.55, 2.0, 4.0])
def test_ramps_last_as_long_as_ruckig_needs(change: float):
    from flockopt.flights.laws.ruckig_law import _Profiles

    phases = _Profiles(LIMITS).ramp(change, False)
    assert sum(seconds for seconds, _ in phases) == pytest.approx(ramp_seconds(change, 4.0, 30.0, False))
    assert min(seconds for seconds, _ in phases) >= SHORTEST_PHASE_S - 1e-12
    assert (len(phases) == 1) == must_be_simple(change, 4.0, 30.0)


def test_the_peak_speed_fills_the_distance():
    peak = peak_speed(0.5, 0.2, 0.8, LIMITS)
    flown = sum((peak + end) / 2 * ramp_seconds(peak - end, 4.0, 30.0, True) for end in (0.5, 0.2))
    assert flown == pytest.approx(0.8)
    assert peak_speed(0.5, 0.2, 50.0, LIMITS) == pytest.approx(2.0)


@pytest.mark.parametrize("seed", range(40))
def test_legs_have_room_for_their_ramps(seed: int):
    points, _ = random_polyline(seed)
    vertices, speeds = corner_speeds(points, np.full(len(points), 2.0), LIMITS, np.zeros(len(points), dtype=bool))
    steps = np.diff(vertices, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    turns = np.zeros(len(points))
    turns[1:-1] = np.linalg.norm(np.diff(steps / lengths[:, None], axis=0), axis=1)
    ramps = np.array([ramp_seconds(speed * turn, 4.0, 30.0, False) for speed, turn in zip(speeds, turns, strict=True)])
    assert speeds[0] == speeds[-1] == 0.0
    assert (speeds[1:-1] > 0.0).all()
    assert (speeds[:-1] * ramps[:-1] / 2 + speeds[1:] * ramps[1:] / 2 < lengths).all()


def make_scene(drones, tasks, obstacles=()):
    return Scene("test", Bounds((0, 0, 0), (10, 10, 4)), drones, tasks, obstacles, clearance=0.1)


@pytest.mark.parametrize("family", ["forest", "corridor", "warehouse", "rooms", "city"])
def test_the_law_is_certified_and_no_slower_than_fly_through(family: str):
    from flockopt.geometry.continuous import curve_clear

    scene = generate(family, drones=4, tasks=10, seed=6)
    bundles = Bundles(tuple(tuple(range(i, 10, 4)) for i in range(4)))
    flights, others = (decode(scene, bundles, law=law) for law in ("ruckig", "fly-through"))
    space = scene.free_space(scene.drones[0].radius + scene.clearance)
    for flight in flights.values():
        curve = flight.curve
        pieces = curve.breakpoints, curve.coefficients
        assert curve_clear(space, *pieces) == -1
        for visit in flight.visits:
            position = scene.tasks[int(visit.task[1:])].position
            np.testing.assert_allclose(curve(visit.time), position, atol=1e-7)
        assert curve.num_pieces <= MOST_PIECES
        for order, limit in enumerate(LIMITS, start=1):
            assert largest(curve, order) <= limit
    mine, theirs = (sum(flight.curve.duration for flight in fleet.values()) for fleet in (flights, others))
    assert mine < 1.01 * theirs


def test_a_task_beside_a_wall_is_reached_without_touching_it():
    from flockopt.geometry.continuous import least_clearance

    walls = (Box("low", (5, 5, 2), (0.2, 6, 4)), Box("side", (7, 7.9, 2), (4, 0.2, 4)))
    tasks = tuple(Task(f"t{j}", place) for j, place in enumerate([(5.33, 7.57, 1), (4.67, 2.2, 1), (5.33, 2.3, 1)]))
    scene = make_scene((Drone("d0", (4.5, 9.5, 1), 5, 0.12, 2.0, 4.0, 30.0),), tasks, walls)
    curve = decode(scene, Bundles(((0, 1, 2),)), law="ruckig")["d0"].curve
    margins = least_clearance(scene.free_space(0.22), curve.breakpoints, curve.coefficients, 1e-6)
    assert margins[0] >= -1e-6


def test_a_route_too_long_for_the_memory_is_flown_with_fewest_pieces():
    places = np.random.default_rng(2).uniform([1, 1, 1], [9, 9, 3], (20, 3))
    tasks = tuple(Task(f"t{j}", tuple(place)) for j, place in enumerate(places))
    scene = make_scene((Drone("d0", (1, 1, 1), 20, 0.12, 2.0, 4.0, 30.0),), tasks)
    assert decode(scene, Bundles((tuple(range(20)),)), law="ruckig")["d0"].curve.num_pieces <= MOST_PIECES


def test_without_ruckig_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(MissingExtra, match=r"ruckig.*flockopt\[trajectory\]"):
        fly(np.array([[0.0, 0, 1], [9, 0, 1]]), np.array([-1.0, 0]))
