import dataclasses
import sys

import numpy as np
import pytest

from flockopt import (
    Box,
    Bundles,
    Curve,
    Flight,
    MissingExtra,
    SettingsError,
    Task,
    Visit,
    compute_travel,
    decode,
    generate,
    plan,
    refine_bundles,
    smooth,
)
from flockopt.flights.smoothing import casadi_stage as stage_module
from flockopt.flights.smoothing.improve import MOTIONLESS, NOTHING_BETTER, SMOOTHED, TOO_HIGH
from flockopt.flights.smoothing.smooth import smooth_each
from flockopt.flights.smoothing.stages import squared_jerk
from flockopt.geometry.bernstein import control_points, piece_states
from flockopt.geometry.continuous import curve_clear, farthest_from
from tests.flights import check_flights, drone, in_order, make_scene

pytest.importorskip("casadi", reason="CasADi comes with the extra 'trajectory'")


def flown(scene, law="fly-through"):
    travel = compute_travel(scene)
    return decode(scene, refine_bundles(scene, travel=travel, iterations=200), travel=travel, law=law)


def check_report(scene, given, report):
    """Never dearer, slower, of more pieces or less feasible than what was given."""
    check_flights(scene, {name: each.flight for name, each in report.items()})
    tasks = {task.id: task for task in scene.tasks}
    drones = {record.id: record for record in scene.drones}
    for name, each in report.items():
        curve, before = each.flight.curve, given[name].curve
        assert each.cost_after <= each.cost_before
        assert (each.status == SMOOTHED) == (each.flight is not given[name])
        assert curve.duration <= before.duration
        assert curve.num_pieces <= before.num_pieces
        assert curve.coefficients.shape[2] <= 8
        firsts, lasts = piece_states(curve.breakpoints, curve.coefficients)
        np.testing.assert_allclose(firsts[1:], lasts[:-1], atol=1e-7)  # C2
        np.testing.assert_allclose(firsts[0], [drones[name].start, drones[name].velocity, drones[name].acceleration], atol=1e-9)
        np.testing.assert_allclose(lasts[-1, 1:], 0.0, atol=1e-7)
        np.testing.assert_allclose(lasts[-1, 0], before(before.end_time), atol=1e-7)
        control = control_points(curve.breakpoints, curve.coefficients, curve.coefficients.shape[2])
        assert (control.min(axis=(0, 2)) > np.array(scene.bounds.lower) - 1.0).all()
        for visit in each.flight.visits:
            task = tasks[visit.task]
            until = visit.time + task.service_time
            away, _ = farthest_from(curve.breakpoints, curve.coefficients, np.array(task.position), visit.time, until)
            assert away <= 1e-6
        assert [visit.task for visit in each.flight.visits] == [visit.task for visit in given[name].visits]


@pytest.mark.parametrize("family", ["forest", "corridor", "warehouse", "rooms", "city"])
def test_families_get_cheaper_and_stay_feasible(family):
    scene = generate(family, drones=4, tasks=8, seed=3)
    given = flown(scene)
    report = smooth_each(scene, given)
    check_report(scene, given, report)
    ratios = [each.cost_after / each.cost_before for each in report.values()]
    assert np.mean(ratios) < 0.95
    assert sum(each.status == SMOOTHED for each in report.values()) >= len(report) - 1


@pytest.fixture(scope="module")
def simple():
    """Two drones around a block, one of them with an end; and their closed-form flights."""
    drones = [drone(0, (1, 1, 1)), drone(1, (9, 1, 1), end=(9, 9, 2))]
    block = Box("b", (5, 4, 2), (2, 3, 4))
    tasks = [(3, 6, 1), (7, 6, 1), (5, 9, 2), (2, 9, 1), (8, 3, 1.5), (6, 2, 1), (9, 6, 2)]
    scene = make_scene(drones, tasks, (block,))
    return scene, decode(scene, in_order(scene))


def test_the_weights_choose_between_time_and_jerk(simple):
    scene, given = simple
    fast = smooth(scene, given, time_weight=0.99, jerk_weight=0.01)
    mixed = smooth_each(scene, given)
    check_report(scene, given, mixed)
    for name in given:
        assert fast[name].curve.duration < 1.002 * mixed[name].flight.curve.duration
        soft = smooth_each(scene, {name: given[name]}, time_weight=0.0)[name]
        assert soft.cost_after < 0.5 * soft.cost_before
        assert soft.cost_after / soft.cost_before < jerk_share(given[name], mixed[name].flight)


def jerk_share(before, after):
    return squared_jerk(*_arrays(after)) / squared_jerk(*_arrays(before))


def test_scaling_both_weights_changes_nothing(simple):
    scene, given = simple
    once, thrice = smooth(scene, given), smooth(scene, given, time_weight=2.25, jerk_weight=0.75)
    for name in given:
        np.testing.assert_allclose(once[name].curve.breakpoints, thrice[name].curve.breakpoints, rtol=1e-6)


def test_smoothing_again_is_never_dearer(simple):
    scene, given = simple
    first = smooth(scene, given)
    check_report(scene, first, smooth_each(scene, first))


def test_processes_find_the_same(simple):
    scene, given = simple
    alone, together = smooth(scene, given), smooth(scene, given, jobs=2)
    assert list(alone) == list(together)
    for name in given:
        np.testing.assert_allclose(alone[name].curve.coefficients, together[name].curve.coefficients, atol=1e-9)


def test_rests_are_kept():
    tasks = [(3, 2, 1), Task("t1", (5, 5, 2), service_time=1.5), (8, 2, 1), Task("t3", (8, 8, 2), service_time=0.4)]
    scene = make_scene([drone(0, (1, 1, 1))], tasks)
    given = decode(scene, in_order(scene))
    report = smooth_each(scene, given)
    assert report["d0"].status == SMOOTHED
    check_report(scene, given, report)
    flight = report["d0"].flight
    for task, seconds in (("t1", 1.5), ("t3", 0.4)):
        time = next(visit.time for visit in flight.visits if visit.task == task)
        assert np.abs(flight.curve(np.linspace(time + 1e-9, time + seconds - 1e-9, 20), 1)).max() <= 1e-9


def test_a_drone_in_motion_goes_on_from_there():
    record = drone(0, (1, 1, 1), velocity=(1.5, 0.5, 0.2), acceleration=(0.0, 1.0, 0.0))
    scene = make_scene([record], [(6, 3, 2), (8, 8, 1)])
    given = decode(scene, in_order(scene))
    report = smooth_each(scene, given)
    assert report["d0"].status == SMOOTHED
    check_report(scene, given, report)


def test_a_drone_at_its_limits_goes_on_from_there():
    scene = make_scene([drone(0, (1, 1, 1), velocity=(2.0, 0.0, 0.0))], [(6, 3, 2), (8, 8, 1)])
    given = decode(scene, in_order(scene))
    check_report(scene, given, smooth_each(scene, given))


@pytest.mark.parametrize("law", ["quintic", "ruckig"])
def test_flights_of_other_laws(law, simple):
    if law == "ruckig":
        pytest.importorskip("ruckig", reason="ruckig comes with the extra 'trajectory'")
    scene, _ = simple
    given = decode(scene, in_order(scene), law=law)
    report = smooth_each(scene, given)
    for name, each in report.items():
        assert each.cost_after <= each.cost_before
        assert each.flight.curve.duration <= given[name].curve.duration
    check_flights(scene, {name: each.flight for name, each in report.items() if each.status == SMOOTHED})


def test_a_later_start_stays(simple):
    scene, given = simple
    late = {name: flight.shifted(3.0) for name, flight in given.items()}
    for name, flight in smooth(scene, late).items():
        assert flight.curve.start_time == 3.0
        assert all(visit.time > 3.0 for visit in flight.visits)
        assert flight.curve.end_time <= late[name].curve.end_time


def test_a_drone_that_stays_is_left_alone():
    scene = make_scene([drone(0, (1, 1, 1))], [Task("t0", (1, 1, 1), service_time=2.0)])
    given = decode(scene, in_order(scene))
    report = smooth_each(scene, given)["d0"]
    assert report.status == MOTIONLESS
    assert report.flight is given["d0"]


def test_a_flight_through_a_wall_never_comes_back_smoothed_through_it():
    wall = Box("b", (5, 5, 2), (0.4, 10, 4))
    scene = make_scene([drone(0, (1, 5, 1)), drone(1, (1, 1, 1))], [(9, 5, 1), (2, 2, 1)])
    blocked = dataclasses.replace(scene, obstacles=(wall,), tasks=scene.tasks[1:])
    given = decode(scene, Bundles(((0,), ())))
    through = {"d0": Flight(given["d0"].curve)}
    report = smooth_each(blocked, through)["d0"]
    assert curve_clear(blocked.free_space(0.22), *_arrays(through["d0"])) >= 0
    assert report.status == NOTHING_BETTER
    assert report.flight is through["d0"]


def _arrays(flight):
    return flight.curve.breakpoints, flight.curve.coefficients


def test_two_tasks_inside_one_piece_leave_it_alone():
    scene = make_scene([drone(0, (1, 1, 1))], [(2, 1, 1), (3, 1, 1)])
    coefficients = np.zeros((1, 3, 6))
    coefficients[0, :, 0] = 1.0
    coefficients[0, 0, 3:] = np.array([10, -15, 6]) * 4.0 / 6.0 ** np.arange(3, 6)  # 4 m in 6 s
    curve = Curve(np.array([0.0, 6.0]), coefficients)
    times = [float(np.interp(x, curve(np.linspace(0, 6, 9001))[:, 0], np.linspace(0, 6, 9001))) for x in (2.0, 3.0)]
    flight = Flight(curve, (Visit("t0", times[0]), Visit("t1", times[1])))
    report = smooth_each(scene, {"d0": flight})["d0"]
    assert report.status == NOTHING_BETTER
    assert report.flight is flight


def test_degrees_above_seven_are_left_alone(simple):
    scene, given = simple
    curve = given["d0"].curve
    high = np.concatenate([curve.coefficients, np.zeros((curve.num_pieces, 3, 5))], axis=2)
    flight = Flight(Curve(curve.breakpoints, high), given["d0"].visits)
    assert smooth_each(scene, {"d0": flight})["d0"].status == TOO_HIGH


def test_an_answer_that_breaks_a_limit_is_refused(simple, monkeypatch):
    scene, given = simple
    monkeypatch.setattr(stage_module, "within_limits", lambda _, stage: stage)
    monkeypatch.setattr(stage_module, "LIMIT_SHARES", np.full(3, 1.2))
    assert {each.status for each in smooth_each(scene, given).values()} == {NOTHING_BETTER}


def test_an_answer_in_an_obstacle_is_refused(simple, monkeypatch):
    scene, given = simple
    monkeypatch.setattr(
        stage_module, "_half_spaces", lambda *_: (np.zeros((len(_[2].durations), 4, 3, 6)), np.zeros((len(_[2].durations), 4)))
    )
    report = smooth_each(scene, given)
    check_report(scene, given, report)
    assert NOTHING_BETTER in {each.status for each in report.values()}


def test_plans_with_smoothing_are_certified_and_no_slower():
    scene = generate("rooms", drones=4, tasks=8, seed=1)
    plain, smoothed = (plan(scene, planner="classical", smoothing=smoothing) for smoothing in (False, True))
    assert smoothed.status == "certified"
    assert "smooth" in smoothed.timing
    assert "smooth" not in plain.timing
    assert smoothed.cost.makespan <= plain.cost.makespan + 1e-9
    assert smoothed.routes == plain.routes


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"time_weight": -1.0}, "time_weight"),
        ({"time_weight": float("nan")}, "time_weight"),
        ({"jerk_weight": float("inf")}, "jerk_weight"),
        ({"jerk_weight": "much"}, "jerk_weight"),
        ({"time_weight": 0, "jerk_weight": 0}, "time_weight"),
        ({"jobs": 0}, "jobs"),
        ({"jobs": 1.5}, "jobs"),
    ],
)
def test_bad_settings(simple, settings, field):
    with pytest.raises(SettingsError, match=f"^{field} is"):
        smooth(*simple, **settings)


def test_foreign_flights(simple):
    scene, given = simple
    with pytest.raises(SettingsError, match="d7"):
        smooth(scene, {"d7": given["d0"]})
    with pytest.raises(SettingsError, match="t99"):
        smooth(scene, {"d0": Flight(given["d0"].curve, (Visit("t99", 1.0),))})


def test_without_casadi_the_extra_is_named(simple, monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(MissingExtra, match=r"flockopt\[trajectory\]"):
        smooth(*simple)
    with pytest.raises(MissingExtra, match="casadi"):
        plan(simple[0], smoothing=True)


def test_the_solver_may_begin_elsewhere_and_never_ends_dearer_than_a_feasible_start():
    scene = generate("forest", drones=4, tasks=8, seed=4)
    given = flown(scene)
    cold = smooth_each(scene, given)
    warm = smooth_each(scene, given, starts={name: each.flight for name, each in cold.items()})
    check_report(scene, given, warm)
    assert all(warm[name].cost_after <= each.cost_after * (1.0 + 1e-9) for name, each in cold.items())
    assert sum(each.iterations for each in warm.values()) < sum(each.iterations for each in cold.values())


def test_a_start_of_other_pieces_is_not_made_use_of(simple):
    scene, given = simple
    first = {
        name: dataclasses.replace(flight, curve=Curve(flight.curve.breakpoints[:2], flight.curve.coefficients[:1]), visits=())
        for name, flight in given.items()
    }
    plain, again = smooth_each(scene, given), smooth_each(scene, given, starts=first)
    assert all(again[name].cost_after == each.cost_after for name, each in plain.items())
