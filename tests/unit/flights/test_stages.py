import numpy as np
import pytest

from flockopt import Curve, Flight, Task, Visit, decode
from flockopt.flights.smoothing.stages import Stage, join, split, squared_jerk
from tests.flights import drone, in_order, make_scene


@pytest.fixture
def flight():
    """Rests at its second task."""
    tasks = [(3, 2, 1), Task("t1", (5, 5, 2), service_time=1.5), (8, 2, 1)]
    scene = make_scene([drone(0, (1, 1, 1))], tasks)
    return decode(scene, in_order(scene))["d0"]


def random_stage(rng, pieces=4):
    return Stage(rng.uniform(0.5, 2.0, pieces), rng.normal(size=(pieces + 1, 3, 3)), ())


def test_joining_what_was_split_changes_nothing(flight):
    same = join(flight, split(flight))
    times = np.linspace(0, flight.curve.end_time, 400)
    for order in range(4):
        np.testing.assert_allclose(same.curve(times, order), flight.curve(times, order), atol=1e-12)
    assert [visit.task for visit in same.visits] == [visit.task for visit in flight.visits]
    np.testing.assert_allclose([visit.time for visit in same.visits], [visit.time for visit in flight.visits], atol=1e-12)


def test_a_rest_is_a_stage_of_its_own(flight):
    stages = split(flight)
    assert [stage.rests for stage in stages] == [False, True, False]
    assert stages[1].seconds == pytest.approx(1.5)
    assert [len(stage.visits) for stage in stages] == [1, 1, 1]


def test_quartics_are_the_quintics_between_their_states(flight):
    for stage in split(flight):
        quintics = stage.slowed(1.0)
        assert quintics.given is None
        np.testing.assert_allclose(quintics.coefficients[:, :, :5], stage.coefficients, atol=1e-9)


def test_pieces_lead_from_state_to_state():
    stage = random_stage(np.random.default_rng(0))
    curve = Curve(stage.breakpoints, stage.coefficients)
    for k, time in enumerate(stage.breakpoints):
        for order in range(3):
            for side in (-1e-9, 1e-9):
                inside = np.clip(time + side, 0, curve.end_time)
                np.testing.assert_allclose(curve(inside, order), stage.states[k, order], atol=1e-5)


def test_slower_is_the_same_path():
    stage = random_stage(np.random.default_rng(1))
    slow = stage.slowed(1.7)
    fast, slow = Curve(stage.breakpoints, stage.coefficients), Curve(slow.breakpoints, slow.coefficients)
    times = np.linspace(0, fast.end_time, 50)
    np.testing.assert_allclose(slow(1.7 * times), fast(times), atol=1e-9)


@pytest.mark.parametrize("terms", [3, 4, 6, 8])
def test_the_jerk_integral_is_what_quadrature_finds(terms):
    rng = np.random.default_rng(terms)
    curve = Curve(np.cumsum([0.0, 0.7, 1.3, 0.4]), rng.normal(size=(3, 3, terms)))
    times = np.linspace(0, curve.end_time, 200_001)[:-1] + curve.end_time / 400_000
    expected = np.mean(np.sum(curve(times, 3) ** 2, axis=1)) * curve.end_time
    assert squared_jerk(curve.breakpoints, curve.coefficients) == pytest.approx(expected, rel=1e-4, abs=1e-12)


def test_slivers_become_part_of_their_neighbour():
    states = np.random.default_rng(2).normal(size=(5, 3, 3))
    stage = Stage(np.array([1.0, 0.02, 1.0, 0.9]), states, ((0, 0.5, 0), (2, 0.5, 1), (3, 1.0, 2)))
    merged = stage.without_slivers()
    np.testing.assert_allclose(merged.durations, [1.02, 1.0, 0.9])
    np.testing.assert_array_equal(merged.states, states[[0, 2, 3, 4]])
    begin = merged.breakpoints
    times = [begin[piece] + phase * merged.durations[piece] for piece, phase, _ in merged.visits]
    np.testing.assert_allclose(times, [0.5, 1.52, 2.92])


def test_a_sliver_with_a_visit_stays():
    stage = Stage(np.array([1.0, 0.02, 1.0]), np.random.default_rng(2).normal(size=(4, 3, 3)), ((1, 0.5, 0),))
    assert len(stage.without_slivers().durations) == 3


def test_visits_at_the_very_end_are_at_the_very_end():
    curve = Curve(np.array([1.0, 2.0]), np.random.default_rng(0).normal(size=(1, 3, 4)))
    joined = join(Flight(curve, (Visit("t0", 2.0),)), split(Flight(curve, (Visit("t0", 2.0),))))
    assert joined.visits[0].time == joined.curve.end_time == 2.0
