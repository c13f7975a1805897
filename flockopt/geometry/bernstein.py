"""Polynomials on an interval by their Bernstein control points: what proofs over continuous time stand on.

A polynomial on [0, 1] lies within the convex hull of its control points, whatever happens between samples;
halving the interval makes that hull tight quadratically (Farouki, "The Bernstein polynomial basis: a centennial
retrospective", 2012). A piece of a curve is held as (3, D) control points over its own duration, which keeps
long and short pieces equally well scaled.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, FLOATS_3, compiled_for, compiled_lazily, writable
from flockopt.records.arrays import FloatArray

__all__ = [
    "control_points", "copy_piece", "derivative", "extreme_coordinates", "extreme_norm", "halve", "largest_norm",
    "largest_value", "least_margin", "piece_states", "squared_norm",
]  # fmt: skip

#: Degrees up to 7 in space, thus up to 14 in a squared norm; one row more than that costs nothing.
BINOMIAL = np.array([[math.comb(n, k) for k in range(16)] for n in range(16)], dtype=np.float64)

#: Extremes are proven to this fraction of themselves.
EXTREME_TOLERANCE = 1e-12

#: Where they are smaller than this, to the same fraction of this: metres, and m/s**n squared.
SMALL_COORDINATE, SMALL_SQUARE = 1.0, 1e-6

#: An interval halved this often is a point for every purpose.
DEEPEST = 44
NARROWEST = 0.5**DEEPEST

#: A search that has looked at this many intervals is lost in rounding errors; it ends with the bounds it has.
MOST_INTERVALS = 200_000


@compiled_for(FLOATS_1, FLOATS_3, types.int64)
def control_points(breakpoints: FloatArray, coefficients: FloatArray, num_terms: int) -> FloatArray:
    """Bernstein control points of every piece of a curve.

    Args:
        breakpoints: (K + 1,) s.
        coefficients: (K, 3, D), D <= num_terms; powers of the time since the piece began.
        num_terms: Degree of the result plus one, at most 8; more than D raises the degree.

    Returns:
        (K, 3, num_terms) m.
    """
    num_pieces, _, given = coefficients.shape
    weights = np.zeros((given, num_terms))  # of every power in every control point
    for n in range(given):
        for i in range(n, num_terms):
            weights[n, i] = BINOMIAL[i, n] / BINOMIAL[num_terms - 1, n]
    result = np.zeros((num_pieces, 3, num_terms))
    # A power t**n is the Bernstein polynomial with control points C(i, n) / C(degree, n), zero before the n-th.
    for k in range(num_pieces):
        duration, scale = breakpoints[k + 1] - breakpoints[k], 1.0
        for n in range(given):
            for axis in range(3):
                term = coefficients[k, axis, n] * scale
                for i in range(n, num_terms):
                    result[k, axis, i] += weights[n, i] * term
            scale *= duration
    return result


@compiled_for(FLOATS_1, FLOATS_3)
def piece_states(breakpoints: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position, velocity and acceleration where every piece begins and where it ends, each (K, 3, 3)."""
    num_pieces, _, num_terms = coefficients.shape
    firsts, lasts = np.zeros((num_pieces, 3, 3)), np.zeros((num_pieces, 3, 3))
    for k in range(num_pieces):
        duration = breakpoints[k + 1] - breakpoints[k]
        for axis in range(3):
            for order in range(min(3, num_terms)):
                value = 0.0
                for n in range(num_terms - 1, order - 1, -1):
                    factor = 1.0 if order == 0 else float(n) if order == 1 else float(n * (n - 1))
                    value = value * duration + factor * coefficients[k, axis, n]
                lasts[k, order, axis] = value
                firsts[k, order, axis] = coefficients[k, axis, order] * (2.0 if order == 2 else 1.0)
    return firsts, lasts


@compiled_for(FLOATS_2, types.float64, types.int64)
def derivative(control: FloatArray, duration: float, order: int) -> FloatArray:
    """Control points (3, max(D - order, 1)) of a derivative of the piece (3, D), per second**order."""
    current = control.copy()
    for _ in range(order):
        degree = current.shape[1] - 1
        if degree == 0:
            return np.zeros((3, 1))
        lower = np.empty((3, degree))
        for axis in range(3):
            for i in range(degree):
                lower[axis, i] = (current[axis, i + 1] - current[axis, i]) * degree / duration
        current = lower
    return current


@compiled_for(FLOATS_2)
def squared_norm(control: FloatArray) -> FloatArray:
    """Control points (2 D - 1,) of the squared Euclidean norm of the piece (3, D)."""
    degree = control.shape[1] - 1
    result = np.zeros(2 * degree + 1)
    for i in range(degree + 1):
        for j in range(degree + 1):
            # The product of two Bernstein polynomials is one of twice the degree, times a ratio of binomials (Farouki 2012).
            product = control[0, i] * control[0, j] + control[1, i] * control[1, j] + control[2, i] * control[2, j]
            result[i + j] += BINOMIAL[degree, i] * BINOMIAL[degree, j] / BINOMIAL[2 * degree, i + j] * product
    return result


@compiled_for(FLOATS_2, writable(FLOATS_2))
def copy_piece(source: FloatArray, target: FloatArray) -> None:
    """Copy control points (rows, D): a slice assigned to a slice takes numba ten times as long to compile."""
    for row in range(source.shape[0]):
        for i in range(source.shape[1]):
            target[row, i] = source[row, i]


@compiled_lazily()
def halve(control: FloatArray, left: FloatArray, right: FloatArray) -> None:
    """De Casteljau's split at the middle: fills ``left`` and ``right``, each (rows, D) like ``control``."""
    num_rows, num_terms = control.shape
    for row in range(num_rows):
        for i in range(num_terms):
            right[row, i] = control[row, i]
        for level in range(num_terms):
            left[row, level] = right[row, 0]
            for i in range(num_terms - 1 - level):
                right[row, i] = 0.5 * (right[row, i] + right[row, i + 1])


@compiled_for(FLOATS_1, types.float64, types.float64)
def largest_value(control: FloatArray, known: float, small: float) -> tuple[float, float]:
    """Largest value on [0, 1] of a polynomial given by (D,) control points, if it is above ``known``.

    Returns:
        An upper bound, tight to `EXTREME_TOLERANCE` times the value or ``small``, and where it is attained;
        (known, -1) if nothing is above it.
    """
    if control.max() <= known:
        return known, -1.0
    num_terms = control.shape[0]
    best, where, proven = known, -1.0, known
    stack = np.empty((DEEPEST + 2, 1, num_terms))
    spans = np.empty((DEEPEST + 2, 2))
    right = np.empty((1, num_terms))
    for i in range(num_terms):
        stack[0, 0, i] = control[i]
    spans[0, 0], spans[0, 1] = 0.0, 1.0
    top, looked = 1, 0
    while top > 0:
        top -= 1
        looked += 1
        node, start, width = stack[top, 0], spans[top, 0], spans[top, 1]
        if node[0] > best:
            best, where = node[0], start
        if node[num_terms - 1] > best:
            best, where = node[num_terms - 1], start + width
        # The end points are values, the largest control point bounds all values: the true maximum is between the two.
        bound = node.max()
        if bound <= best + EXTREME_TOLERANCE * max(abs(best), small) or width < NARROWEST or looked > MOST_INTERVALS:
            proven = max(proven, bound)
            continue
        halve(stack[top], stack[top], right)
        left_first = stack[top].max() > right.max()  # the more promising half is looked at first
        if left_first:
            copy_piece(stack[top], stack[top + 1])
            copy_piece(right, stack[top])
        else:
            copy_piece(right, stack[top + 1])
        half = 0.5 * width
        spans[top, 0], spans[top + 1, 0] = (start + half, start) if left_first else (start, start + half)
        spans[top, 1] = spans[top + 1, 1] = half
        top += 2
    return proven if proven > best else best, where


@compiled_for(FLOATS_1, FLOATS_3, types.int64)
def largest_norm(breakpoints: FloatArray, control: FloatArray, order: int) -> tuple[float, float]:
    """Largest Euclidean norm of a derivative over a whole curve, and the time of it.

    Args:
        breakpoints: (K + 1,) s.
        control: (K, 3, D) control points.
        order: 1 for speed, 2 for acceleration, 3 for jerk.

    Returns:
        m/s**order, an upper bound tight to `EXTREME_TOLERANCE`; and seconds.
    """
    best, time = -1.0, breakpoints[0]
    for k in range(control.shape[0]):
        duration = breakpoints[k + 1] - breakpoints[k]
        square, where = largest_value(squared_norm(derivative(control[k], duration, order)), best, SMALL_SQUARE)
        if where >= 0.0:
            best, time = square, breakpoints[k] + where * duration
    return math.sqrt(max(best, 0.0)), time


@compiled_for(FLOATS_1, FLOATS_3, FLOATS_1, FLOATS_1)
def least_margin(
    breakpoints: FloatArray, control: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[float, float, int]:
    """How far inside an axis-aligned box a curve stays at its worst.

    Args:
        breakpoints: (K + 1,) s.
        control: (K, 3, D) control points.
        lower: (3,) m.
        upper: (3,) m.

    Returns:
        The margin in metres (negative outside), a lower bound tight to 1e-12; its time; the axis.
    """
    worst, time, worst_axis = -np.inf, breakpoints[0], 0
    for k in range(control.shape[0]):
        for axis in range(3):
            for side in range(2):
                excess = lower[axis] - control[k, axis] if side == 0 else control[k, axis] - upper[axis]
                value, where = largest_value(excess, worst, SMALL_COORDINATE)
                if where >= 0.0:
                    worst, worst_axis = value, axis
                    time = breakpoints[k] + where * (breakpoints[k + 1] - breakpoints[k])
    return -worst, time, worst_axis


def extreme_norm(coefficients: FloatArray, duration: float, order: int) -> tuple[float, float]:
    """Largest norm of a derivative over one piece, (3, D), and the local time of it: see `largest_norm`."""
    breakpoints = np.array([0.0, duration])
    piece = np.ascontiguousarray(coefficients, dtype=np.float64)[None]
    return largest_norm(breakpoints, control_points(breakpoints, piece, piece.shape[2]), order)


def extreme_coordinates(coefficients: FloatArray, duration: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The box one piece (3, D) fits in: lower (3,) m, upper (3,) m, and the local times (2, 3) of those extremes."""
    breakpoints = np.array([0.0, duration])
    piece = np.ascontiguousarray(coefficients, dtype=np.float64)[None]
    control = control_points(breakpoints, piece, piece.shape[2])[0]
    low = [largest_value(-control[axis], -np.inf, SMALL_COORDINATE) for axis in range(3)]
    high = [largest_value(control[axis], -np.inf, SMALL_COORDINATE) for axis in range(3)]
    times = np.array([[where for _, where in low], [where for _, where in high]]) * duration
    return -np.array([value for value, _ in low]), np.array([value for value, _ in high]), times
