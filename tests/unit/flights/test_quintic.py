"""The paper's decoder: splines, their fit, correction, stops at anchors."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import Bounds, Box, Bundles, Cylinder, Drone, Scene, SettingsError, Task, compute_travel, generate
from flockopt.flights.decode import decode
from flockopt.flights.laws.catmull_rom import CatmullRom
from flockopt.flights.laws.correction import INFLATION, corrected, corrected_samples
from flockopt.flights.laws.fly_through import first_outside
from flockopt.flights.laws.quintic import decode_quintic, progress
from flockopt.flights.laws.refit import fit_operator, fit_phases
from flockopt.flights.room import MOST_PIECES, Room
from flockopt.flights.waypoints import Waypoints, leg_clear, waypoints_from_paths
from flockopt.geometry.bernstein import control_points, largest_norm
from flockopt.geometry.continuous import curve_clear

BOUNDS = Bounds((0, 0, 0), (10, 10, 4))


def drone(index: int, start: tuple, capacity: int = 5, **fields) -> Drone:
    limits = {"radius": 0.12, "max_speed": 2.0, "max_acceleration": 4.0, "max_jerk": 30.0}
    return Drone(f"d{index}", start, capacity, **(limits | fields))


def make_scene(drones: list, tasks: list, obstacles: tuple = ()) -> Scene:
    records = [task if isinstance(task, Task) else Task(f"t{j}", task) for j, task in enumerate(tasks)]
    return Scene("test", BOUNDS, tuple(drones), tuple(records), obstacles, clearance=0.1, separation=0.4)


def dealt_out(scene: Scene) -> Bundles:
    routes, left = [], list(range(scene.num_tasks))
    for record in scene.drones:
        routes.append(tuple(left[: record.capacity]))
        left = left[record.capacity :]
    return Bundles(tuple(routes))


def ways(scene: Scene, bundles: Bundles) -> dict[int, Waypoints]:
    travel = compute_travel(scene)
    found = {index: waypoints_from_paths(scene, travel, index, route) for index, route in enumerate(bundles)}
    return {index: way for index, way in found.items() if way.moves}


def check(scene: Scene, flights: dict) -> None:
    positions = {task.id: task.position for task in scene.tasks}
    for record in scene.drones:
        if record.id not in flights:
            continue
        curve, space = flights[record.id].curve, scene.free_space(record.radius + scene.clearance)
        pieces = curve.breakpoints, curve.coefficients
        assert curve_clear(space, *pieces) == -1
        assert first_outside(space, *pieces) == -1
        control = control_points(*pieces, curve.coefficients.shape[2])
        for order, limit in enumerate((record.max_speed, record.max_acceleration, record.max_jerk), start=1):
            assert largest_norm(curve.breakpoints, control, order)[0] <= limit
        inner = curve.breakpoints[1:-1]
        for order, tolerance in enumerate((1e-8, 1e-7, 1e-5)):
            np.testing.assert_allclose(curve(inner - 1e-13, order), curve(inner, order), atol=tolerance)
        for visit in flights[record.id].visits:
            np.testing.assert_allclose(curve(visit.time), positions[visit.task], atol=1e-9)
            np.testing.assert_allclose(curve(visit.time, 1), 0.0, atol=1e-8)
            np.testing.assert_allclose(curve(visit.time, 2), 0.0, atol=1e-6)


@pytest.mark.parametrize("family", ["forest", "corridor", "warehouse", "rooms", "city"])
def test_flights_are_clear_within_limits_and_stop_at_every_task(family: str):
    scene = generate(family, drones=5, tasks=14, seed=2)
    decoding = decode_quintic(scene, ways(scene, dealt_out(scene)))
    check(scene, decoding.flights)
    assert max(flight.curve.num_pieces for flight in decoding.flights.values()) <= MOST_PIECES
    assert max(decoding.fit_error_m.values()) < 0.02


def test_a_fleet_is_decoded_as_its_drones_are():
    scene = generate("forest", drones=4, tasks=12, seed=3)
    way = ways(scene, dealt_out(scene))
    together = decode_quintic(scene, way).flights
    for index in way:
        alone = decode_quintic(scene, {index: way[index]}).flights[scene.drones[index].id]
        np.testing.assert_allclose(alone.curve.breakpoints, together[scene.drones[index].id].curve.breakpoints)
        np.testing.assert_allclose(alone.curve.coefficients, together[scene.drones[index].id].curve.coefficients, atol=1e-9)


def test_a_straight_leg_is_the_minimum_jerk_law():
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 1, 1)])
    curve = decode(scene, dealt_out(scene), law="quintic")["d0"].curve
    phases = np.linspace(0, 1, 33)
    np.testing.assert_allclose(curve(phases * curve.duration)[:, 0], 1 + 8 * progress(phases), atol=1e-9)
    fastest = 0.999 * 2.0
    assert curve.duration == pytest.approx(1.875 * 8 / fastest)


def test_the_flight_is_as_far_from_the_spline_as_reported():
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 9, 1)])
    corners = np.array([[1, 1, 1], [4, 1.5, 1], [5, 6, 2], [9, 9, 1.0]])
    way = Waypoints(corners, np.array([-1.0, -1, -1, 0]), ((), (), (), (0,)))
    decoding = decode_quintic(scene, {0: way})
    curve = decoding.flights["d0"].curve
    spline = CatmullRom(corners, np.array([0, 4]), np.array([False]))
    phases = np.linspace(0, 1, 2001)
    gaps = np.linalg.norm(curve(phases * curve.duration) - spline(np.zeros(2001, dtype=int), progress(phases)), axis=1)
    assert gaps.max() <= decoding.fit_error_m["d0"] <= 2.0 * gaps.max()
    assert gaps.max() < 0.02


def test_the_spline_is_the_textbook_pyramid():
    points = np.array([[0.0, 0, 0], [1, 2, 0], [4, 2, 1], [5, 0, 3]])
    curve = CatmullRom(points, np.array([0, 4]), np.array([False]))
    knots = curve.knots
    for time in np.linspace(knots[1], knots[2], 7):
        level = [points[i] + (time - knots[i]) / (knots[i + 1] - knots[i]) * (points[i + 1] - points[i]) for i in range(3)]
        level = [
            level[i] + (time - knots[i]) / (knots[i + 2] - knots[i]) * (level[i + 1] - level[i]) for i in range(2)
        ]  # Barry and Goldman 1988
        expected = level[0] + (time - knots[1]) / (knots[2] - knots[1]) * (level[1] - level[0])
        np.testing.assert_allclose(curve(np.array([0]), np.array([time / knots[3]]))[0], expected, atol=1e-12)


def test_a_spline_cut_into_legs_is_the_same_curve():
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 9, (7, 3))
    whole = CatmullRom(points, np.array([0, 7]), np.array([False]))
    cut = CatmullRom(points[[0, 1, 2, 3, 3, 4, 5, 6]], np.array([0, 4, 8]), np.array([False, True]))
    np.testing.assert_allclose(cut.slopes[[0, 1, 2, 3, 5, 6, 7]], whole.slopes)
    np.testing.assert_allclose(cut.slopes[3], cut.slopes[4])
    loose = CatmullRom(cut.points, cut.first, np.array([False, False]))
    assert np.abs(loose.slopes[3] - loose.slopes[4]).max() > 0.1


@pytest.mark.parametrize("num_pieces", [1, 2, 5, 16])
def test_a_fit_keeps_its_ends_and_joints(num_pieces: int):
    rng = np.random.default_rng(num_pieces)
    phases = fit_phases(num_pieces)
    samples = np.cumsum(rng.normal(size=len(phases)))
    pieces = (fit_operator(num_pieces) @ samples).reshape(num_pieces, 8)
    powers = np.arange(8)
    lasts = [pieces @ np.array([np.prod(powers[n] - np.arange(order)) for n in powers]) for order in range(3)]
    firsts = [pieces[:, order] * np.prod(np.arange(1, order + 1)) for order in range(3)]
    for order in range(3):
        np.testing.assert_allclose(lasts[order][:-1], firsts[order][1:], atol=1e-7)
        np.testing.assert_allclose(firsts[order][0], samples[0] if order == 0 else 0.0, atol=1e-8)
        np.testing.assert_allclose(lasts[order][-1], samples[-1] if order == 0 else 0.0, atol=1e-7)


def test_no_other_fit_with_the_same_joints_is_nearer():
    phases = fit_phases(2)
    samples = np.sin(5 * progress(phases))
    operator = fit_operator(2)
    piece = np.minimum((2 * phases).astype(int), 1)
    powers = (2 * phases - piece)[:, None] ** np.arange(8)
    best = operator @ samples

    def misfit(series: np.ndarray) -> float:
        return float(np.sum((np.sum(powers * series.reshape(2, 8)[piece], axis=1) - samples) ** 2))

    rng = np.random.default_rng(0)
    for _ in range(20):
        bump = rng.normal(size=len(phases)) * (phases > 0) * (phases < 1)
        assert misfit(best) <= misfit(best + 1e-3 * operator @ bump)


def test_service_time_is_held_at_the_anchor():
    scene = make_scene(
        [drone(0, (1, 1, 1))], [Task("t0", (4, 1, 1), service_time=1.5), Task("t1", (8, 3, 1), service_time=0.5)]
    )
    flight = decode(scene, dealt_out(scene), law="quintic")["d0"]
    check(scene, {"d0": flight})
    np.testing.assert_allclose(
        flight.curve(flight.visits[0].time + np.linspace(0, 1.5, 9)), np.tile([4, 1, 1], (9, 1)), atol=1e-9
    )
    assert flight.curve.end_time == pytest.approx(flight.visits[1].time + 0.5)


def test_control_points_in_inflated_obstacles_are_moved_out():
    pillars = (Cylinder("a", (5, 5, 2), 0.8, 4.0), Box("b", (2, 8, 2), (1, 1, 4), 0.4))
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 9, 1)], pillars)
    room = Room.around(scene, scene.drones[0], Waypoints(np.array([[1.0, 1, 1], [9, 1, 1]]), np.zeros(2), ((), ())))
    control = np.array([[1.0, 1, 1], [5.1, 5.2, 1.5], [2.2, 8.1, 2], [9, 9, 1]])
    moved = corrected(control, room, 0.12)
    from flockopt.geometry.distances import distances

    np.testing.assert_array_equal(moved[[0, -1]], control[[0, -1]])
    assert distances(scene.obstacle_table, moved[1:-1]).min() >= 0.22 + INFLATION * 0.12 - 1e-6
    np.testing.assert_allclose(
        moved[1, :2] - [5, 5], (control[1, :2] - [5, 5]) * np.linalg.norm(moved[1, :2] - 5) / np.hypot(0.1, 0.2)
    )


def test_samples_through_a_pillar_go_around_it_on_their_side():
    pillar = Cylinder("pillar", (5, 5, 2), 0.6, 4.0)
    scene = make_scene([drone(0, (1, 4.9, 1))], [(9, 4.9, 1)], (pillar,))
    line = np.linspace([1, 4.9, 1], [9, 4.9, 1], 64)
    line[1:-1, 1] += 0.4  # a little to the far side of the axis: the any-angle path goes by the near one
    flights = decode(scene, dealt_out(scene), line[None], law="quintic")
    check(scene, flights)
    assert flights["d0"].curve(flights["d0"].curve.duration / 2)[1] > 5.8
    way = corrected_samples(scene, compute_travel(scene), 0, (0,), line)
    assert 4 <= len(way.points) < 40
    assert leg_clear(scene, 0, way.points)


def test_samples_behind_a_wall_are_replaced_by_the_clear_way():
    walls = (Box("wall", (5, 4, 2), (0.4, 8, 4)),)
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 1, 1)], walls)
    line = np.linspace([1, 1, 1], [9, 1, 1], 64)
    check(scene, decode(scene, dealt_out(scene), line[None], law="quintic"))


@pytest.mark.parametrize(("half_width", "stops"), [(0.2205, True), (0.4, False)])
def test_a_curve_that_cuts_in_is_corrected_at_worst_down_to_stops(half_width: float, stops: bool):
    """A bend in a tube: a narrow one leaves no room for a smooth curve, a wider one does."""
    inner, outer = 5 - half_width, 5 + half_width
    walls = (
        Box("below", (5, inner / 2, 2), (10, inner, 4)),
        Box("beyond", ((outer + 10) / 2, 5, 2), (10 - outer, 10, 4)),
        Box("inside", (inner / 2, (outer + 10) / 2, 2), (inner, 10 - outer, 4)),
    )
    scene = make_scene([drone(0, (1, 5, 1))], [(5, 9, 1)], walls)
    way = Waypoints(np.array([[1.0, 5, 1], [5, 5, 1], [5, 9, 1]]), np.array([-1.0, -1, 0]), ((), (), (0,)))
    flights = decode_quintic(scene, {0: way}).flights
    check(scene, flights)
    curve = flights["d0"].curve
    slowest = np.linalg.norm(curve(curve.duration * np.linspace(0.2, 0.8, 601), 1), axis=1).min()
    assert (slowest < 0.01) == stops


def test_a_long_route_fits_the_trajectory_memory():
    rng = np.random.default_rng(2)
    scene = make_scene([drone(0, (1, 1, 1), 20)], [tuple(point) for point in rng.uniform([1, 1, 1], [9, 9, 3], (20, 3))])
    flights = decode(scene, dealt_out(scene), law="quintic")
    assert flights["d0"].curve.num_pieces <= MOST_PIECES
    check(scene, flights)


def test_a_short_leash_keeps_to_the_polyline():
    tasks = [(5, 1, 1), (5, 5, 1), (1, 5, 1)]
    loose = make_scene([drone(0, (1, 1, 1))], tasks)
    travel = compute_travel(loose).route_length(0, (0, 1, 2))
    assert decode(loose, dealt_out(loose), law="quintic")["d0"].curve.length > travel + 0.05
    leashed = make_scene([drone(0, (1, 1, 1), max_distance=travel + 0.01)], tasks)
    flight = decode(leashed, dealt_out(leashed), law="quintic")["d0"]
    assert flight.curve.length == pytest.approx(travel)
    check(leashed, {"d0": flight})


def test_a_moving_start_is_refused():
    scene = make_scene([drone(0, (2, 2, 1), velocity=(1.0, 0.5, 0.0))], [(8, 8, 2)])
    with pytest.raises(SettingsError, match=r"drones\[0\].velocity.*fly-through"):
        decode(scene, dealt_out(scene), law="quintic")


def test_fly_through_is_much_faster():
    scene = generate("warehouse", drones=4, tasks=12, seed=1)
    stop, fly = (decode(scene, dealt_out(scene), law=law) for law in ("quintic", "fly-through"))
    slow, fast = (max(flight.curve.end_time for flight in flights.values()) for flights in (stop, fly))
    assert fast < 0.65 * slow
