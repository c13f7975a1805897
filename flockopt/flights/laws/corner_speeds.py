"""How fast corners may be taken when legs speed up and slow down between them.

Around a corner the velocity turns at one speed: it changes by ``speed * (direction out - direction in)`` along a
jerk-limited ramp, half before and half after the vertex. Vertices lie a little outside the points they belong to,
so that the curve passes exactly through those. Each leg must hold half of both its corners' ramps, and between them
room to change from one corner's speed to the other's: that bounds the speeds.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLAGS_1, FLOATS_1, FLOATS_2, compiled_for, compiled_lazily
from flockopt.records.arrays import FloatArray

__all__ = ["SHORTEST_PHASE_S", "corner_speeds", "must_be_simple", "peak_speed", "ramp_seconds"]

#: Phases shorter than this are avoided, seconds: rounding a position moves the jerk of so short a piece.
SHORTEST_PHASE_S = 2e-3

#: Rounds in which speeds and vertices settle together, and vertices alone at given speeds.
SPEED_ROUNDS, VERTEX_ROUNDS = 60, 60

#: What a leg's ramps aim to take of it and may take of it; what is left is flown straight, however short.
USABLE_SHARE, MOST_SHARE = 0.985, 0.99

#: Where a leg is too short after all, both its corners become slower by this factor until it is not.
SLOWER = 0.97
MOST_SLOWDOWNS = 400

#: A factor by which speeds grow at most in one round.
GROWTH = 1.25


@compiled_for(types.float64, types.float64, types.float64)
def must_be_simple(change: float, max_acceleration: float, max_jerk: float) -> bool:
    """Whether the fastest ramp would have a phase that is too short."""
    rising, holding = max_acceleration / max_jerk, change / max_acceleration - max_acceleration / max_jerk
    if holding <= 0.0:
        return math.sqrt(change / max_jerk) < SHORTEST_PHASE_S
    return min(rising, holding) < SHORTEST_PHASE_S


@compiled_for(types.float64, types.float64, types.float64, types.boolean)
def ramp_seconds(change: float, max_acceleration: float, max_jerk: float, simple: bool) -> float:
    """Duration of a ramp between two velocities that differ by ``change`` m/s, with no acceleration at its ends.

    A simple ramp is one polynomial piece (`flockopt.flights.laws.fly_through`), another has up to three of constant jerk
    and is the fastest there is.
    """
    if simple or must_be_simple(change, max_acceleration, max_jerk):
        return max(1.5 * change / max_acceleration, math.sqrt(6.0 * change / max_jerk), SHORTEST_PHASE_S)
    if change >= max_acceleration**2 / max_jerk:
        return change / max_acceleration + max_acceleration / max_jerk
    return 2.0 * math.sqrt(change / max_jerk)


@compiled_lazily()
def _mid_offset(change: float, max_acceleration: float, max_jerk: float, simple: bool) -> float:
    """Metres by which the first half of a ramp leads away from going on at the first velocity."""
    seconds = ramp_seconds(change, max_acceleration, max_jerk, simple)
    if simple or must_be_simple(change, max_acceleration, max_jerk):
        return 3.0 / 32.0 * seconds * change
    rising = min(max_acceleration / max_jerk, seconds / 2)
    holding = seconds / 2 - rising
    return max_jerk * rising * (rising**2 / 6 + rising * holding / 2 + holding**2 / 2)


@compiled_lazily()
def _change_distance(one: float, other: float, limits: FloatArray) -> float:
    """Metres flown while the speed changes from one to the other by a simple ramp: at their mean, by symmetry."""
    return 0.5 * (one + other) * ramp_seconds(abs(one - other), limits[1], limits[2], True)


@compiled_for(types.float64, types.float64, types.float64, FLOATS_1)
def peak_speed(start: float, end: float, distance: float, limits: FloatArray) -> float:
    """The highest speed, m/s, that two simple ramps reach and leave again within a distance."""
    low, high = max(start, end), limits[0]
    for _ in range(60):
        middle = 0.5 * (low + high)
        if _change_distance(start, middle, limits) + _change_distance(middle, end, limits) <= distance:
            low = middle
        else:
            high = middle
    return low


@compiled_lazily()
def _directions(vertices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors (n, 3) along the legs, and their lengths (n,) m."""
    legs = vertices.shape[0] - 1
    directions, lengths = np.empty((legs, 3)), np.empty(legs)
    for k in range(legs):
        step = vertices[k + 1] - vertices[k]
        lengths[k] = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        directions[k] = step / max(lengths[k], 1e-12)
    return directions, lengths


@compiled_lazily()
def _turns(directions: FloatArray) -> FloatArray:
    """Norms (n + 1,) of the change of direction at every vertex; zero at both ends."""
    result = np.zeros(directions.shape[0] + 1)
    for k in range(1, directions.shape[0]):
        turn = directions[k] - directions[k - 1]
        result[k] = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    return result


@compiled_lazily()
def _moved_vertices(
    points: FloatArray, vertices: FloatArray, speeds: FloatArray, limits: FloatArray, simple: NDArray[np.bool_]
) -> FloatArray:
    """Vertices (n + 1, 3) from which curves turning as at ``vertices`` pass through ``points``."""
    directions, _ = _directions(vertices)
    turns = _turns(directions)
    result = points.copy()
    for k in range(1, points.shape[0] - 1):
        if turns[k] > 0.0:
            offset = _mid_offset(speeds[k] * turns[k], limits[1], limits[2], simple[k]) / turns[k]
            result[k] = points[k] - offset * (directions[k] - directions[k - 1])
    return result


@compiled_lazily()
def _needs(
    vertices: FloatArray, speeds: FloatArray, limits: FloatArray, simple: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """What each leg (n,) needs for its ramps, and what it has, metres."""
    directions, lengths = _directions(vertices)
    turns = _turns(directions)
    result = np.empty(len(lengths))
    for k in range(len(lengths)):
        result[k] = _change_distance(speeds[k], speeds[k + 1], limits)
        for corner in (k, k + 1):
            seconds = ramp_seconds(speeds[corner] * turns[corner], limits[1], limits[2], simple[corner])
            result[k] += 0.5 * speeds[corner] * seconds
    return result, lengths


@compiled_for(FLOATS_2, FLOATS_1, FLOATS_1, FLAGS_1)
def corner_speeds(
    points: FloatArray, caps: FloatArray, limits: FloatArray, simple: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Speeds at the points of a way that begins and ends at rest.

    Args:
        points: (n + 1, 3) m, consecutive ones apart.
        caps: (n + 1,) m/s, the highest speed at each point; of no effect at both ends.
        limits: (3,) greatest speed, acceleration and jerk.
        simple: (n + 1,) whether a corner's ramp is to be a simple one.

    Returns:
        Vertices (n + 1, 3) m, whose legs the drone flies along, and the speeds (n + 1,) m/s around them.
    """
    last = len(points) - 1
    speeds = caps.copy()
    speeds[0] = speeds[last] = 0.0
    vertices = points.copy()
    for _ in range(SPEED_ROUNDS):
        needs, lengths = _needs(vertices, speeds, limits, simple)
        factors = np.full(last + 1, GROWTH)
        for k in range(last):
            fit = math.sqrt(USABLE_SHARE * lengths[k] / max(needs[k], 1e-12))
            faster = max(speeds[k], speeds[k + 1], 1e-9)
            for corner in (k, k + 1):
                # A short leg slows the faster of its corners, which needs most of it.
                factors[corner] = min(factors[corner], fit ** (0.7 * (speeds[corner] / faster) ** 2))
        for k in range(1, last):
            speeds[k] = min(caps[k], speeds[k] * factors[k])
        vertices = _moved_vertices(points, vertices, speeds, limits, simple)
    for _ in range(MOST_SLOWDOWNS):
        for _ in range(VERTEX_ROUNDS):
            moved = _moved_vertices(points, vertices, speeds, limits, simple)
            change = np.abs(moved - vertices).max()
            vertices = moved
            if change < 1e-12:
                break
        needs, lengths = _needs(vertices, speeds, limits, simple)
        short = False
        for k in range(last):
            if needs[k] > MOST_SHARE * lengths[k]:
                short = True
                for corner in (k, k + 1):
                    speeds[corner] *= SLOWER
        if not short:
            break
    return vertices, speeds
