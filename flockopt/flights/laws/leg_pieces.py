"""Compiled work on legs made of polynomial pieces: whether they are clear, how fast they may be flown, joining them.

The pieces of all legs lie in one array (P, 3, 8), each a polynomial in its fraction 0 to 1 of equal parts of its
leg's time; ``first`` (L + 1,) says where each leg's pieces begin.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, FLOATS_3, INTEGERS_1, compiled_for
from flockopt.flights.laws.fly_through import first_outside
from flockopt.geometry.bernstein import SMALL_SQUARE, control_points, derivative, largest_value, squared_norm
from flockopt.geometry.continuous import curve_clear
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.records.arrays import FloatArray

__all__ = ["assembled", "faulty_legs", "leg_seconds"]


@compiled_for(FLOATS_3, INTEGERS_1, FLOATS_1, INTEGERS_1, FLOATS_2, FLOATS_1)
def assembled(
    pieces: FloatArray, counts: NDArray[np.int64], seconds: FloatArray, ends: NDArray[np.int64], points: FloatArray,
    rest_s: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """One drone's flight along its legs in turn, with a rest where its waypoints ask for one.

    Args:
        pieces: (P, 3, D).
        counts: (L,) pieces of each leg.
        seconds: (L,) of each leg.
        ends: (L,) the waypoint each leg ends at, or -1.
        points: (n + 1, 3) m, the waypoints.
        rest_s: (n + 1,) s; as `Waypoints.rest_s`.

    Returns:
        Breakpoints (K + 1,) s, coefficients (K, 3, D) and the time at each waypoint that ends a leg (n + 1,) s.
    """
    num_rests = 0
    for end in ends:
        num_rests += end >= 0 and rest_s[end] > 0.0
    total = pieces.shape[0] + num_rests
    breakpoints, coefficients, times = np.zeros(total + 1), np.zeros((total, 3, pieces.shape[2])), np.zeros(len(points))
    piece, k, clock = 0, 0, 0.0
    for leg in range(len(counts)):
        duration = seconds[leg] / counts[leg]
        for part in range(counts[leg]):
            scale = 1.0
            for n in range(pieces.shape[2]):
                for axis in range(3):
                    coefficients[k, axis, n] = pieces[piece, axis, n] * scale
                scale /= duration
            breakpoints[k + 1] = clock + (part + 1) * duration
            piece, k = piece + 1, k + 1
        clock += seconds[leg]
        end = ends[leg]
        if end >= 0:
            times[end] = clock
            if rest_s[end] > 0.0:
                coefficients[k, :, 0] = points[end]
                clock += rest_s[end]
                breakpoints[k + 1] = clock
                k += 1
    return breakpoints, coefficients, times


@compiled_for(FLOATS_3, INTEGERS_1, FREE_SPACE)
def faulty_legs(pieces: FloatArray, first: NDArray[np.int64], space: FreeSpace) -> NDArray[np.bool_]:
    """Which of one drone's legs (L,) come too near to an obstacle or leave the bounds."""
    result = np.zeros(len(first) - 1, dtype=np.bool_)
    for leg in range(len(result)):
        part = pieces[first[leg] : first[leg + 1]]
        breakpoints = np.arange(len(part) + 1) * 1.0
        result[leg] = first_outside(space, breakpoints, part) >= 0 or curve_clear(space, breakpoints, part) >= 0
    return result


@compiled_for(FLOATS_3, INTEGERS_1, FLOATS_2)
def leg_seconds(pieces: FloatArray, first: NDArray[np.int64], limits: FloatArray) -> FloatArray:
    """The shortest duration of every leg (L,) that keeps its limits (L, 3) at every instant."""
    result = np.zeros(len(first) - 1)
    for leg in range(len(result)):
        part = pieces[first[leg] : first[leg + 1]]
        control = control_points(np.arange(len(part) + 1) * 1.0, part, part.shape[2])
        step = 0.0  # seconds a piece
        for order in range(1, 4):
            # Flown at s seconds a piece, its n-th derivative is divided by s**n. Squares not above what the steps
            # found so far allow need no search.
            square = (limits[leg, order - 1] * step**order) ** 2
            for k in range(len(part)):
                square = largest_value(squared_norm(derivative(control[k], 1.0, order)), square, SMALL_SQUARE)[0]
            step = max(step, (math.sqrt(square) / limits[leg, order - 1]) ** (1.0 / order))
        result[leg] = len(part) * step
    return result
