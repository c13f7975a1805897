"""Proofs over continuous time against dense sampling: never above the truth, and not far below."""

import numpy as np
import pytest

from flockopt.flights import Curve
from flockopt.geometry.bernstein import (
    control_points,
    extreme_coordinates,
    extreme_norm,
    largest_norm,
    least_margin,
    piece_states,
)
from flockopt.geometry.continuous import curve_clear, farthest_from, first_conflict, least_clearance, least_separation, parked
from flockopt.geometry.distances import distances
from flockopt.geometry.free_space import free_space
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.parts import obstacle_table

TOLERANCE_M = 1e-6
ANYWHERE = (np.full(3, -np.inf), np.full(3, np.inf))


def random_table(rng, count):
    kinds = (
        lambda k, at: Box(f"o{k}", at, tuple(rng.uniform(0.2, 3, 3)), float(rng.uniform(-3, 3))),
        lambda k, at: Cylinder(f"o{k}", at, float(rng.uniform(0.2, 1.5)), float(rng.uniform(0.3, 4))),
        lambda k, at: Sphere(f"o{k}", at, float(rng.uniform(0.2, 1.5))),
    )
    return obstacle_table(kinds[rng.integers(3)](k, tuple(rng.uniform(0, 10, 3))) for k in range(count))


def random_curve(rng, degree, side=10.0):
    """Continuous, of any degree: each piece's control points begin where the last one ended."""
    spans = rng.uniform(0.3, 4.0, int(rng.integers(1, 6)))
    breakpoints = np.concatenate([[rng.uniform(0, 2)], spans]).cumsum()
    powers = np.arange(degree + 1)
    coefficients = rng.normal(size=(len(spans), 3, degree + 1)) * 3 / spans[:, None, None] ** powers
    place = rng.uniform(0, side, 3)
    for k, span in enumerate(spans):
        coefficients[k, :, 0] = place
        place = coefficients[k] @ span**powers
    return Curve(breakpoints, coefficients)


def sampled(curve, count=8001):
    return np.linspace(curve.start_time, curve.end_time, count)


@pytest.mark.parametrize("seed", range(40))
def test_least_clearance_bounds_dense_samples_tightly(seed):
    rng = np.random.default_rng(seed)
    table, curve = random_table(rng, int(rng.integers(1, 20))), random_curve(rng, seed % 8)
    needs = rng.uniform(0, 0.5, len(table))
    space, arrays = free_space(table, needs, ANYWHERE), (curve.breakpoints, curve.coefficients)
    margin, time, obstacle = least_clearance(space, *arrays, TOLERANCE_M)
    gaps = distances(table, curve(sampled(curve))) - needs  # (T, K)
    assert margin <= gaps.min() + 1e-9
    assert margin == pytest.approx((distances(table, curve(time)) - needs)[0, obstacle], abs=2 * TOLERANCE_M)
    first = curve_clear(space, *arrays)
    if margin > TOLERANCE_M:
        assert first == -1
    if margin < -TOLERANCE_M:
        assert 0 <= first <= np.searchsorted(curve.breakpoints, time + 1e-9, side="right") - 1


def test_no_obstacles_leave_an_infinite_margin():
    space = free_space(obstacle_table([]), 0.0, ANYWHERE)
    margin, _, obstacle = least_clearance(space, *parked(np.ones(3)), TOLERANCE_M)
    assert (margin, obstacle) == (np.inf, -1)


def test_a_dip_between_any_samples_is_found():
    # 1 mm into the need for about 4 ms, in a piece that lasts 40 s
    space = free_space(obstacle_table([Sphere("s", (0.0, 0.0, 0.0), 1.0)]), 0.1, ANYWHERE)
    curve = Curve([0.0, 40.0], [[[-200.0, 10.0], [1.099, 0.0], [0.0, 0.0]]])
    margin, time, _ = least_clearance(space, curve.breakpoints, curve.coefficients, TOLERANCE_M)
    assert margin == pytest.approx(-1e-3, abs=TOLERANCE_M)
    assert time == pytest.approx(20.0, abs=1e-2)
    assert curve_clear(space, curve.breakpoints, curve.coefficients) == 0


@pytest.mark.parametrize("seed", range(40))
def test_least_separation_and_first_conflict_agree_with_dense_samples(seed):
    rng = np.random.default_rng(100 + seed)
    a, b = random_curve(rng, seed % 8, 2.0), random_curve(rng, (3 * seed) % 8, 2.0)
    axes, end = np.array([0.5, 0.5, 1.0]), max(a.end_time, b.end_time) + 1.0
    first, second = (a.breakpoints, a.coefficients), (b.breakpoints, b.coefficients)

    def margin_at(times):
        return (np.linalg.norm((a(times) - b(times)) / axes, axis=-1) - 1.0) * axes[0]

    margin, time = least_separation(*first, *second, axes, 0.0, end, TOLERANCE_M, np.inf)
    times = np.linspace(0.0, end, 20001)
    truth = margin_at(times)
    assert margin <= truth.min() + 1e-9
    assert margin == pytest.approx(margin_at(time), abs=2 * TOLERANCE_M)
    conflict = first_conflict(*first, 0.0, 1.0, *second, 0.0, 1.0, axes, 0.0, end)
    assert (conflict >= 0.0) == (margin < 0.0)
    if (truth < 0.0).any():
        assert margin_at(conflict) < 0.0
        assert conflict <= times[np.argmax(truth < 0.0)] + 2e-3


def test_known_margins_are_not_looked_for_again():
    rng = np.random.default_rng(5)
    a, b = random_curve(rng, 5), random_curve(rng, 5)
    arrays = (a.breakpoints, a.coefficients, b.breakpoints, b.coefficients, np.ones(3), 0.0, 20.0, TOLERANCE_M)
    margin, _ = least_separation(*arrays, np.inf)
    assert least_separation(*arrays, margin + 0.5) == pytest.approx(least_separation(*arrays, np.inf), abs=1e-5)
    assert least_separation(*arrays, margin - 0.5) == pytest.approx((margin - 0.5, -1.0))


def test_shift_and_stretch_fly_later_and_slower():
    rng = np.random.default_rng(6)
    conflicts = 0
    for _ in range(60):
        a, b = random_curve(rng, 4, 2.0), random_curve(rng, 3, 2.0)
        shift, stretch = float(rng.uniform(0, 3)), float(rng.uniform(1, 2))
        moved = a.stretched(stretch).shifted(shift)
        rest = (b.breakpoints, b.coefficients, 0.0, 1.0, np.full(3, 0.7), 0.0, 30.0)
        direct = first_conflict(moved.breakpoints, moved.coefficients, 0.0, 1.0, *rest)
        assert first_conflict(a.breakpoints, a.coefficients, shift, stretch, *rest) == pytest.approx(direct, abs=2e-3)
        conflicts += direct >= 0.0
    assert 5 < conflicts < 60


def test_parked_drones_count_before_and_after_their_flights():
    curve = Curve([1.0, 2.0], [[[0.0, 3.0], [0.0, 0.0], [0.0, 0.0]]])  # from x = 0 to x = 3
    axes = np.ones(3)
    arrays = (curve.breakpoints, curve.coefficients)
    assert least_separation(*arrays, *parked(np.array([-1.5, 0, 0])), axes, 0.0, 1.0, TOLERANCE_M, np.inf)[0] == pytest.approx(
        0.5
    )
    assert least_separation(*arrays, *parked(np.array([3.5, 0, 0])), axes, 2.0, 9.0, TOLERANCE_M, np.inf)[0] == pytest.approx(
        -0.5
    )


@pytest.mark.parametrize("seed", range(30))
def test_extremes_of_norms_and_coordinates_bound_dense_samples_tightly(seed):
    rng = np.random.default_rng(200 + seed)
    degree, span = seed % 8, float(rng.choice([0.05, 1.0, 40.0]))
    terms = rng.normal(size=(3, degree + 1)) / span ** np.arange(degree + 1)
    curve = Curve([0.0, span], terms[None])
    for order in (1, 2, 3):
        norm, time = extreme_norm(terms, span, order)
        values = np.linalg.norm(curve(np.linspace(0, span, 4001), order), axis=1)
        assert values.max() <= norm * (1 + 1e-11) + 1e-12
        assert np.linalg.norm(curve(time, order)) == pytest.approx(norm, rel=1e-6, abs=1e-8)
    lower, upper, times = extreme_coordinates(terms, span)
    places = curve(np.linspace(0, span, 4001))
    assert (lower <= places.min(axis=0) + 1e-11).all() and (places.max(axis=0) <= upper + 1e-11).all()
    assert [curve(times[0, axis])[axis] for axis in range(3)] == pytest.approx(lower, abs=1e-9)
    assert [curve(times[1, axis])[axis] for axis in range(3)] == pytest.approx(upper, abs=1e-9)


def test_extremes_of_whole_curves_are_those_of_their_worst_pieces():
    rng = np.random.default_rng(7)
    curve = random_curve(rng, 6)
    control = control_points(curve.breakpoints, curve.coefficients, 8)  # raised to degree 7
    spans = np.diff(curve.breakpoints)
    norms = [extreme_norm(curve.coefficients[k], spans[k], 2)[0] for k in range(curve.num_pieces)]
    assert largest_norm(curve.breakpoints, control, 2)[0] == pytest.approx(max(norms), rel=1e-9)
    low, high = np.array([extreme_coordinates(curve.coefficients[k], spans[k])[:2] for k in range(curve.num_pieces)]).transpose(
        1, 0, 2
    )
    margin, time, axis = least_margin(curve.breakpoints, control, np.full(3, -50.0), np.full(3, 60.0))
    assert margin == pytest.approx(min((low + 50.0).min(), (60.0 - high).min()))
    assert min(curve(time)[axis] + 50.0, 60.0 - curve(time)[axis]) == pytest.approx(margin)


def test_farthest_from_bounds_dense_samples_tightly():
    rng = np.random.default_rng(8)
    for degree in range(8):
        curve = random_curve(rng, degree)
        start, end = np.sort(rng.uniform(0, curve.end_time + 1, 2))
        away, time = farthest_from(curve.breakpoints, curve.coefficients, np.ones(3), start, end)
        truth = np.linalg.norm(curve(np.linspace(start, end, 4001)) - 1.0, axis=1).max()
        assert truth <= away * (1 + 1e-9)
        assert np.linalg.norm(curve(time) - 1.0) == pytest.approx(away, rel=1e-6)
        assert farthest_from(curve.breakpoints, curve.coefficients, np.ones(3), end, end)[0] == pytest.approx(
            float(np.linalg.norm(curve(end) - 1.0))
        )


def test_piece_states_are_the_curve_and_its_derivatives_at_the_breakpoints():
    curve = random_curve(np.random.default_rng(9), 7)
    firsts, lasts = piece_states(curve.breakpoints, curve.coefficients)
    for order in range(3):
        assert firsts[:, order] == pytest.approx(curve(curve.breakpoints[:-1], order))
        assert lasts[-1, order] == pytest.approx(curve(curve.end_time, order))


@pytest.mark.parametrize("scale", [1e6, 1e12, 1e150])
def test_absurd_curves_end_in_an_answer(scale):
    rng = np.random.default_rng(10)
    space = free_space(obstacle_table([Sphere("s", (0.0, 0.0, 0.0), 1.0)]), 1.0, ANYWHERE)
    curve = Curve([0.0, 1e-3, 2.0], rng.normal(size=(2, 3, 8)) * scale)
    arrays = (curve.breakpoints, curve.coefficients)
    assert np.isfinite(least_clearance(space, *arrays, 1e-7)[0])
    assert np.isfinite(least_separation(*arrays, *parked(np.zeros(3)), np.ones(3), 0.0, 3.0, 1e-7, np.inf)[0])
