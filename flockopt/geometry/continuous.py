"""Continuous-time checks of curves: clearance from obstacles and separation of two drones, proven between samples.

The judge and the planners share these functions, so that they cannot disagree about a distance. Curves come as
their breakpoints (K + 1,) and coefficients (K, 3, D) with D <= 8, and hold still before and after. The proofs are
branch and bound over time (`flockopt.geometry.intervals`); boxes around control points keep most pieces out of it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_3, compiled_for, compiled_lazily
from flockopt.geometry.bernstein import BINOMIAL, SMALL_SQUARE, control_points, copy_piece, largest_value, squared_norm
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.geometry.intervals import (
    box_gap,
    end_norm,
    first_inside,
    fit_box,
    least_clearance_below,
    least_norm_below,
    new_stack,
)
from flockopt.geometry.kernels import point_distance
from flockopt.records.arrays import FloatArray

__all__ = [
    "curve_clear", "farthest_from", "first_conflict", "least_clearance", "least_separation", "parked",
]  # fmt: skip

#: Yes-or-no checks prove that a curve comes at most this much too near, and name only places that are at least
#: half of it too near: between the two either answer is right, so that a curve which grazes is decided at once.
GRAZING_M = 1e-7


def parked(position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Breakpoints and coefficients of a drone that never moves from ``position`` (3,) m."""
    return np.array([0.0, 1.0]), np.array(position, dtype=np.float64).reshape(1, 3, 1)


@compiled_lazily()
def _nearest_breakpoint(space: FreeSpace, breakpoints: FloatArray, control: FloatArray) -> tuple[float, float, int]:
    """The least margin at the pieces' ends, a good first guess of the least of all: margin, time, obstacle."""
    best, time, nearest = np.inf, breakpoints[0], -1
    point = np.empty((2, 3))
    for p in range(control.shape[0] + 1):
        for axis in range(3):
            point[:, axis] = control[p, axis, 0] if p < control.shape[0] else control[p - 1, axis, -1]
        for k in range(space.table.shape[0]):
            if box_gap(point, space.boxes[k]) - space.needs[k] < best:
                margin = point_distance(space.table[k], point[0, 0], point[0, 1], point[0, 2]) - space.needs[k]
                if margin < best:
                    best, time, nearest = margin, breakpoints[p], k
    return best, time, nearest


@compiled_for(FREE_SPACE, FLOATS_1, FLOATS_3, types.float64)
def least_clearance(
    space: FreeSpace, breakpoints: FloatArray, coefficients: FloatArray, tolerance: float
) -> tuple[float, float, int]:
    """By how much a curve clears every obstacle at its worst, over all time.

    Args:
        space: What to keep clear of; its bounds do not count.
        breakpoints: (P + 1,) s.
        coefficients: (P, 3, D).
        tolerance: Metres the answer may lie below the true margin; it never lies above.

    Returns:
        The least of distance - need in metres, its time in seconds, and the obstacle (-1 and infinite margin
        if there is none).
    """
    num_terms = coefficients.shape[2]
    control = control_points(breakpoints, coefficients, num_terms)
    stack, spans = new_stack(num_terms)
    box = np.empty((2, 3))
    best, time, nearest = _nearest_breakpoint(space, breakpoints, control)
    proven = best
    for p in range(control.shape[0]):
        fit_box(control[p], box)  # holds the piece, by the convex hull of its control points
        for k in range(space.table.shape[0]):
            row, need = space.table[k], space.needs[k]
            if box_gap(box, space.boxes[k]) - need >= best:
                continue
            margin, where, bound = least_clearance_below(control[p], row, need, best, tolerance, -np.inf, stack, spans)
            proven = min(proven, bound)
            if where >= 0.0:
                best, nearest = margin, k
                time = breakpoints[p] + where * (breakpoints[p + 1] - breakpoints[p])
    return min(best, proven), time, nearest


@compiled_for(FREE_SPACE, FLOATS_1, FLOATS_3)
def curve_clear(space: FreeSpace, breakpoints: FloatArray, coefficients: FloatArray) -> int:
    """Index of the first piece that is too near to an obstacle (see `GRAZING_M`), or -1; arguments as in `least_clearance`."""
    num_terms = coefficients.shape[2]
    control = control_points(breakpoints, coefficients, num_terms)
    stack, spans = new_stack(num_terms)
    box = np.empty((2, 3))
    graze = 0.5 * GRAZING_M
    for p in range(control.shape[0]):
        fit_box(control[p], box)
        for k in range(space.table.shape[0]):
            row, need = space.table[k], space.needs[k]
            if box_gap(box, space.boxes[k]) >= need:
                continue
            least, _, _ = least_clearance_below(control[p], row, need, 0.0, graze, -graze, stack, spans)
            if least < -graze:
                return p
    return -1


@compiled_for(FLOATS_1, FLOATS_3, types.float64, types.float64, FLOATS_1, types.int64)
def _timed(
    breakpoints: FloatArray, coefficients: FloatArray, shift: float, stretch: float, axes: FloatArray, num_terms: int
) -> tuple[FloatArray, FloatArray]:
    """A curve for all time: times (K + 3,) from -inf to inf, control points (K + 2, 3, D) in units of ``axes``.

    The first and the last piece are where it holds still.
    """
    inner = control_points(breakpoints, coefficients, num_terms)
    num_pieces = inner.shape[0]
    times, control = np.empty(num_pieces + 3), np.empty((num_pieces + 2, 3, num_terms))
    times[0], times[num_pieces + 2] = -np.inf, np.inf
    for k in range(num_pieces + 1):
        times[k + 1] = breakpoints[k] * stretch + shift
    for axis in range(3):
        for k in range(num_pieces):
            for i in range(num_terms):
                control[k + 1, axis, i] = inner[k, axis, i] / axes[axis]
        # Pieces that hold still: all control points are one. So windows of two curves need no special cases.
        control[0, axis, :] = control[1, axis, 0]
        control[num_pieces + 1, axis, :] = control[num_pieces, axis, num_terms - 1]
    return times, control


@compiled_lazily()
def _hulls(control: FloatArray) -> FloatArray:
    """Bounding boxes (K + 1, 2, 3) of every piece's control points (K, 3, D), and last the one of all of them."""
    num_pieces = control.shape[0]
    boxes = np.empty((num_pieces + 1, 2, 3))
    boxes[num_pieces, 0], boxes[num_pieces, 1] = np.inf, -np.inf
    for k in range(num_pieces):
        fit_box(control[k], boxes[k])
        for axis in range(3):
            boxes[num_pieces, 0, axis] = min(boxes[num_pieces, 0, axis], boxes[k, 0, axis])
            boxes[num_pieces, 1, axis] = max(boxes[num_pieces, 1, axis], boxes[k, 1, axis])
    return boxes


@compiled_lazily()
def _restrict(piece: FloatArray, start: float, end: float, result: FloatArray) -> None:
    """Fill ``result`` with the control points (3, D) of the part of a piece between two fractions of it."""
    num_terms = piece.shape[1]
    for axis in range(3):
        points = result[axis]
        for i in range(num_terms):
            points[i] = piece[axis, i]
        # De Casteljau twice: the part before the end, in place from the last point on; of that, what comes after the start.
        if end < 1.0:
            for level in range(1, num_terms):
                for i in range(num_terms - 1, level - 1, -1):
                    points[i] += (end - 1.0) * (points[i] - points[i - 1])
        if start > 0.0:
            along = start / end
            for level in range(1, num_terms):
                for i in range(num_terms - level):
                    points[i] += along * (points[i + 1] - points[i])


@compiled_lazily()
def _part(times: FloatArray, control: FloatArray, k: int, start: float, end: float, result: FloatArray) -> None:
    """Fill ``result`` with piece ``k`` of a timed curve between two times within it."""
    if k == 0 or k == control.shape[0] - 1:
        copy_piece(control[k], result)
    else:
        duration = times[k + 1] - times[k]
        # Rounding may carry the fractions over the piece's ends; nothing flies there.
        first, last = max((start - times[k]) / duration, 0.0), min((end - times[k]) / duration, 1.0)
        _restrict(control[k], first, max(last, 1e-300), result)


@compiled_for(FLOATS_1, FLOATS_3, FLOATS_1, types.float64, types.float64)
def farthest_from(
    breakpoints: FloatArray, coefficients: FloatArray, point: FloatArray, start: float, end: float
) -> tuple[float, float]:
    """How far a curve gets from a point (3,) m between two times: metres, tight to 1e-9, and the time in seconds."""
    num_terms = coefficients.shape[2]
    times, control = _timed(breakpoints, coefficients, 0.0, 1.0, np.ones(3), num_terms)
    part = np.empty((3, num_terms))
    best, time, k, now = -1.0, start, 0, start
    while True:
        while times[k + 1] <= now:
            k += 1
        until = min(end, times[k + 1])
        _part(times, control, k, now, until, part)
        for axis in range(3):
            for i in range(num_terms):
                part[axis, i] -= point[axis]
        square, where = largest_value(squared_norm(part), best, SMALL_SQUARE)
        if where >= 0.0:
            best, time = square, now + where * (until - now)
        if until >= end:
            return math.sqrt(max(best, 0.0)), time
        now = until


@compiled_lazily()
def _subtract(other: FloatArray, piece: FloatArray) -> None:
    """Take control points (rows, D) off those of a piece."""
    for row in range(piece.shape[0]):
        for i in range(piece.shape[1]):
            piece[row, i] -= other[row, i]


@compiled_lazily()
def _place(times: FloatArray, control: FloatArray, k: int, time: float, point: FloatArray) -> None:
    """Fill ``point`` (3, 1) with where piece ``k`` of a timed curve is at a time."""
    num_terms = control.shape[2]
    fraction = 0.0
    if 0 < k < control.shape[0] - 1:
        fraction = (time - times[k]) / (times[k + 1] - times[k])
    for axis in range(3):
        value, power = 0.0, 1.0
        for i in range(num_terms):  # Horner's scheme in the Bernstein basis
            value = value * (1.0 - fraction) + BINOMIAL[num_terms - 1, i] * power * control[k, axis, i]
            power *= fraction
        point[axis, 0] = value


@compiled_lazily()
def _windows(times_a: FloatArray, times_b: FloatArray, start: float, end: float) -> tuple[NDArray[np.int64], FloatArray]:
    """The pieces of two timed curves that are flown together between two times.

    Returns:
        (W + 1, 2) the piece of either curve from each moment on, and the moments (W + 1,), of which the last is the end.
    """
    room = len(times_a) + len(times_b) + 2
    pieces, moments = np.zeros((room, 2), dtype=np.int64), np.empty(room)
    i, j, count, now = 0, 0, 0, start
    while True:
        while times_a[i + 1] <= now:
            i += 1
        while times_b[j + 1] <= now:
            j += 1
        pieces[count, 0], pieces[count, 1], moments[count] = i, j, now
        count += 1
        # Where both times are one there is still one window, without width: the curves are looked at there.
        if now >= end and count > 1:
            return pieces[:count], moments[:count]
        now = min(end, times_a[i + 1], times_b[j + 1])


@compiled_lazily()
def _nearest_moment(
    times_a: FloatArray, control_a: FloatArray, times_b: FloatArray, control_b: FloatArray, pieces: NDArray[np.int64],
    moments: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """The least distance at the moments of `_windows`, a good first guess of the least of all; its time."""
    best, time = np.inf, moments[0]
    here, there = np.empty((3, 1)), np.empty((3, 1))
    for w in range(len(moments)):
        _place(times_a, control_a, pieces[w, 0], moments[w], here)
        _place(times_b, control_b, pieces[w, 1], moments[w], there)
        _subtract(there, here)
        distance = end_norm(here, 0)
        if distance < best:
            best, time = distance, moments[w]
    return best, time


@compiled_for(
    FLOATS_1, FLOATS_3, FLOATS_1, FLOATS_3, FLOATS_1, types.float64, types.float64, types.float64, types.float64,
)  # fmt: skip
def least_separation(
    bp_a: FloatArray, co_a: FloatArray, bp_b: FloatArray, co_b: FloatArray, axes: FloatArray,
    start: float, end: float, tolerance: float, known: float,
) -> tuple[float, float]:  # fmt: skip
    """By how much two drones keep apart at their worst between two times.

    Args:
        bp_a: (K + 1,) s, the first drone's breakpoints.
        co_a: (K, 3, D), its coefficients.
        bp_b: (L + 1,) s.
        co_b: (L, 3, E).
        axes: (3,) m, half axes of the ellipsoid to stay out of (`Scene.axes_between`), all > 0.
        start: Seconds.
        end: Seconds, >= start.
        tolerance: Metres the answer may lie below the true margin; it never lies above.
        known: Metres; margins above it need not be found, which saves time. Infinite to find any.

    Returns:
        (|(dx, dy, dz) / axes| - 1) * axes[0] at its least, in metres, and its time in seconds; (about ``known``, -1) if
        it is not below that.
    """
    num_terms = max(co_a.shape[2], co_b.shape[2])
    times_a, control_a = _timed(bp_a, co_a, 0.0, 1.0, axes, num_terms)
    times_b, control_b = _timed(bp_b, co_b, 0.0, 1.0, axes, num_terms)
    hulls_a, hulls_b = _hulls(control_a), _hulls(control_b)
    stack, spans = new_stack(num_terms)
    other = np.empty((3, num_terms))
    pieces, moments = _windows(times_a, times_b, start, end)
    best, time = _nearest_moment(times_a, control_a, times_b, control_b, pieces, moments)
    if best > known / axes[0] + 1.0:
        best, time = known / axes[0] + 1.0, -1.0
    proven = best
    for w in range(len(moments) - 1):
        i, j, now, until = pieces[w, 0], pieces[w, 1], moments[w], moments[w + 1]
        if box_gap(hulls_a[i], hulls_b[j]) < best:
            _part(times_a, control_a, i, now, until, stack[0])
            _part(times_b, control_b, j, now, until, other)
            _subtract(other, stack[0])
            best, where, bound = least_norm_below(best, tolerance / axes[0], stack, spans)
            proven = min(proven, bound)
            if where >= 0.0:
                time = now + where * (until - now)
    return (min(best, proven) - 1.0) * axes[0], time


@compiled_for(
    FLOATS_1, FLOATS_3, types.float64, types.float64, FLOATS_1, FLOATS_3, types.float64, types.float64,
    FLOATS_1, types.float64, types.float64,
)  # fmt: skip
def first_conflict(
    bp_a: FloatArray, co_a: FloatArray, shift_a: float, stretch_a: float,
    bp_b: FloatArray, co_b: FloatArray, shift_b: float, stretch_b: float,
    axes: FloatArray, start: float, end: float,
) -> float:  # fmt: skip
    """When two drones first come too near (see `GRAZING_M`) between two times, or -1.

    Breakpoints become ``breakpoints * stretch + shift``: a shift > 0 flies later, a stretch > 1 slower. The
    other arguments are as in `least_separation`; the answer is at most a millisecond after the first moment.
    """
    num_terms = max(co_a.shape[2], co_b.shape[2])
    times_a, control_a = _timed(bp_a, co_a, shift_a, stretch_a, axes, num_terms)
    times_b, control_b = _timed(bp_b, co_b, shift_b, stretch_b, axes, num_terms)
    hulls_a, hulls_b = _hulls(control_a), _hulls(control_b)
    if box_gap(hulls_a[-1], hulls_b[-1]) >= 1.0:
        return -1.0
    stack, spans = new_stack(num_terms)
    other = np.empty((3, num_terms))
    pieces, moments = _windows(times_a, times_b, start, end)
    for w in range(len(moments) - 1):
        i, j, now, until = pieces[w, 0], pieces[w, 1], moments[w], moments[w + 1]
        if box_gap(hulls_a[i], hulls_b[j]) < 1.0:
            _part(times_a, control_a, i, now, until, stack[0])
            _part(times_b, control_b, j, now, until, other)
            _subtract(other, stack[0])
            where = first_inside(until - now, GRAZING_M / axes[0], stack, spans)
            if where >= 0.0:
                return now + where * (until - now)
    return -1.0
