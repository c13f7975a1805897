"""Flying a polyline without stopping: constant velocities joined by smooth velocity blends.

Each leg of a control polygon is flown at one velocity. Around each vertex the velocity turns from the incoming
``w_in`` to the outgoing ``w_out`` along the smooth step ``S(tau) = 3 tau**2 - 2 tau**3`` of the blend's phase::

    velocity = w_in + (w_out - w_in) * S(t / T)        a quartic piece of duration T

(linear segments with parabolic blends, Paul 1981, made C2.) Everything is closed form: speed never exceeds that
of the two legs, acceleration peaks at ``1.5 |w_out - w_in| / T`` and jerk at ``6 |w_out - w_in| / T**2``. Halfway
through its blend the curve is ``3/32 T (w_out - w_in)`` away from the vertex, so vertices are placed, by one
tridiagonal solve, where the curve passes exactly through the points it was given.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches.compiled import FLOATS_1, FLOATS_2, FLOATS_3, compiled_for, compiled_lazily
from flockopt.geometry.bernstein import control_points, least_margin
from flockopt.geometry.free_space import FREE_SPACE, FreeSpace
from flockopt.records.arrays import FloatArray

__all__ = ["first_outside", "fly_polyline"]

#: Offset of the curve from a vertex at mid-blend, as a fraction of T (w_out - w_in): the integral of S to 1/2.
MID_BLEND = 3.0 / 32.0

#: Rounds of the fixed point that finds leg and blend durations; it converges to a few parts in a thousand, and
#: what is left is taken up by one uniform time scaling.
ROUNDS = 24

#: A curve that leaves the bounds by no more than this does so by rounding alone, metres.
GRAZING_M = 1e-9

#: A cruise shorter than this fraction of its leg is dropped: its two blends meet.
SHORTEST_CRUISE = 4e-3


@compiled_lazily()
def _blend_seconds(change: float, max_acceleration: float, max_jerk: float) -> float:
    """Shortest blend for a change of velocity of norm ``change``."""
    return max(1.5 * change / max_acceleration, math.sqrt(6.0 * change / max_jerk), 1e-4)


@compiled_lazily()
def _control_vertices(
    points: FloatArray, leg_s: FloatArray, blend_s: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Vertices from which the curve passes through ``points`` (Thomas algorithm on a tridiagonal system)."""
    last = points.shape[0] - 1
    vertices = points.copy()
    for axis in range(3):
        t = blend_s[0]
        vertices[0, axis] = points[0, axis] + velocity[axis] * t / 2 + acceleration[axis] * t * t / 12
    upper = np.zeros(last + 1)
    for k in range(1, last):
        before = MID_BLEND * blend_s[k] / leg_s[k - 1]
        after = MID_BLEND * blend_s[k] / leg_s[k]
        pivot = 1.0 - before - after - before * upper[k - 1]
        upper[k] = after / pivot
        for axis in range(3):
            vertices[k, axis] = (points[k, axis] - before * vertices[k - 1, axis]) / pivot
    for k in range(last - 1, 0, -1):
        for axis in range(3):
            vertices[k, axis] -= upper[k] * vertices[k + 1, axis]
    return vertices


@compiled_lazily()
def _leg_velocities(vertices: FloatArray, leg_s: FloatArray, velocity: FloatArray) -> FloatArray:
    """Velocities before, along and after the legs: (n + 2, 3), the last one zero."""
    legs = leg_s.shape[0]
    result = np.zeros((legs + 2, 3))
    for axis in range(3):
        result[0, axis] = velocity[axis]
        for k in range(legs):
            result[k + 1, axis] = (vertices[k + 1, axis] - vertices[k, axis]) / leg_s[k]
    return result


@compiled_for(FLOATS_1)
def _norm(vector: FloatArray) -> float:
    return math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@compiled_lazily()
def _change(velocities: FloatArray, k: int) -> float:
    return math.sqrt(
        (velocities[k + 1, 0] - velocities[k, 0]) ** 2
        + (velocities[k + 1, 1] - velocities[k, 1]) ** 2
        + (velocities[k + 1, 2] - velocities[k, 2]) ** 2
    )


@compiled_lazily()
def _without_cruises(leg_s: FloatArray, blend_s: FloatArray, unwanted: int) -> FloatArray:
    """Longer blends, so that on up to ``unwanted`` legs the two meet and no cruise is left between them.

    The shortest cruises go first. A longer blend also reaches into the leg on its other side, which must have
    room for it.
    """
    legs = leg_s.shape[0]
    blend_s = blend_s.copy()
    slack = leg_s - (blend_s[:-1] + blend_s[1:]) / 2
    for _ in range(unwanted):
        chosen, share = -1, 0.0
        for k in range(legs):
            left = 2 * slack[k - 1] if k > 0 else np.inf
            right = 2 * slack[k + 1] if k + 1 < legs else np.inf
            if slack[k] > 1e-9 and left + right >= 2 * slack[k] and (chosen < 0 or slack[k] < slack[chosen]):
                chosen, share = k, min(left, max(slack[k], 2 * slack[k] - right))
        if chosen < 0:
            break
        blend_s[chosen] += share
        blend_s[chosen + 1] += 2 * slack[chosen] - share
        slack = leg_s - (blend_s[:-1] + blend_s[1:]) / 2
    return blend_s


@compiled_lazily()
def _durations(
    points: FloatArray, caps: FloatArray, limits: FloatArray, velocity: FloatArray, acceleration: FloatArray, unwanted: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Leg seconds, blend seconds and control vertices of one stage that ends at rest.

    The blends at both ends of a leg may not overlap, and each must be long enough for its change of velocity,
    which in turn depends on the legs' durations: a fixed point, damped by geometric means.
    """
    legs = points.shape[0] - 1
    leg_s, blend_s = np.empty(legs), np.full(legs + 1, 1e-4)
    for k in range(legs):
        leg_s[k] = max(_norm(points[k + 1] - points[k]) / caps[k], 1e-3)
    vertices = points.copy()
    for _ in range(ROUNDS):
        velocities = _leg_velocities(vertices, leg_s, velocity)
        for k in range(legs + 1):
            blend_s[k] = _blend_seconds(_change(velocities, k), limits[1], limits[2])
        if _norm(velocity) + _norm(acceleration) > 0.0:
            blend_s[0] = _entry_seconds(velocity, acceleration, velocities[1], limits)
        for k in range(legs):
            needed = max(_norm(vertices[k + 1] - vertices[k]) / caps[k], (blend_s[k] + blend_s[k + 1]) / 2)
            leg_s[k] = math.sqrt(leg_s[k] * needed)
        vertices = _control_vertices(points, leg_s, _fitting(blend_s, leg_s), velocity, acceleration)
    blend_s = _fitting(blend_s, leg_s)
    for k in range(legs):
        meeting = (blend_s[k] + blend_s[k + 1]) / 2
        if leg_s[k] - meeting < SHORTEST_CRUISE * leg_s[k]:
            leg_s[k] = meeting
    blend_s = _without_cruises(leg_s, blend_s, unwanted)
    return leg_s, blend_s, _control_vertices(points, leg_s, blend_s, velocity, acceleration)


@compiled_lazily()
def _fitting(blend_s: FloatArray, leg_s: FloatArray) -> FloatArray:
    """Blends shortened where two of them would overlap on a leg."""
    result = blend_s.copy()
    for k in range(leg_s.shape[0]):
        overlap = (blend_s[k] + blend_s[k + 1]) / 2 / leg_s[k]
        if overlap > 1.0:
            result[k] = min(result[k], blend_s[k] / overlap)
            result[k + 1] = min(result[k + 1], blend_s[k + 1] / overlap)
    return result


@compiled_lazily()
def _entry_seconds(velocity: FloatArray, acceleration: FloatArray, target: FloatArray, limits: FloatArray) -> float:
    """Blend duration from a moving start: the shortest on a geometric grid that keeps every limit at 33 samples."""
    shortest = _blend_seconds(_norm(target - velocity), limits[1], limits[2])
    best, least_excess = shortest, np.inf
    seconds = shortest
    for _ in range(24):
        excess = 0.0
        for step in range(33):
            tau = step / 32.0
            speed = acceleration_norm = jerk = 0.0
            for axis in range(3):
                dw = target[axis] - velocity[axis]
                a = acceleration[axis]
                v = velocity[axis] + dw * (3 * tau**2 - 2 * tau**3) + a * seconds * (tau - 2 * tau**2 + tau**3)
                speed += v * v
                acceleration_norm += (dw * 6 * (tau - tau**2) / seconds + a * (1 - 4 * tau + 3 * tau**2)) ** 2
                jerk += (dw * (6 - 12 * tau) / seconds**2 + a * (6 * tau - 4) / seconds) ** 2
            squares = (speed / limits[0] ** 2, acceleration_norm / limits[1] ** 2, jerk / limits[2] ** 2)
            excess = max(excess, math.sqrt(max(squares)))
        if excess <= 1.0:
            return seconds
        if excess < least_excess:
            best, least_excess = seconds, excess
        seconds *= 1.12
    return best


@compiled_lazily()
def _time_scale(leg_s: FloatArray, blend_s: FloatArray, velocities: FloatArray, caps: FloatArray, limits: FloatArray) -> float:
    """How much slower the stage must be flown for every limit to hold: at least about 1."""
    scale = 0.0
    for k in range(leg_s.shape[0] + 1):
        change = _change(velocities, k)
        scale = max(scale, math.sqrt(1.5 * change / blend_s[k] / limits[1]))
        scale = max(scale, (6.0 * change / blend_s[k] ** 2 / limits[2]) ** (1.0 / 3.0))
        if k < leg_s.shape[0]:
            scale = max(scale, _norm(velocities[k + 1]) / caps[k])
    return scale


@compiled_lazily()
def _fill_blend(
    piece: FloatArray, start: FloatArray, before: FloatArray, after: FloatArray, acceleration: FloatArray, seconds: float
) -> None:
    """Write a blend's coefficients (3, 5): from ``start`` at velocity ``before`` and ``acceleration`` to ``after`` and none."""
    for axis in range(3):
        change, a = after[axis] - before[axis], acceleration[axis]
        piece[axis, 0], piece[axis, 1], piece[axis, 2] = start[axis], before[axis], a / 2
        piece[axis, 3] = change / seconds**2 - 2 * a / (3 * seconds)
        piece[axis, 4] = -change / (2 * seconds**3) + a / (4 * seconds**2)


@compiled_for(FLOATS_2, *[FLOATS_1] * 5, types.int64)
def fly_polyline(
    points: FloatArray,
    rest_s: FloatArray,
    caps: FloatArray,
    limits: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
    unwanted: int,
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.int64]]:
    """A C2 flight through every point of a polyline.

    Args:
        points: (n + 1, 3) m, consecutive ones apart; n >= 1.
        rest_s: (n + 1,) s; -1 to fly through a point, >= 0 to come to rest there for so long. The last one rests.
        caps: (n,) m/s, the highest speed on each leg.
        limits: (3,) greatest speed, acceleration and jerk.
        velocity: (3,) m/s at the first point.
        acceleration: (3,) m/s2 at the first point.
        unwanted: How many cruises to do without between two stops, at the price of longer blends.

    Returns:
        breakpoints (K + 1,) s from 0; coefficients (K, 3, 5); the time at each point (n + 1,) s; and for each
        piece its owner (K,): 2 k for the blend around point k or the rest at it, 2 k + 1 for the cruise after it.
    """
    # Over 60 lines: stages, their blends and cruises are written one after another into the same four arrays, each where
    # the last one ended; a stage on its own would hand ten numbers and arrays back and forth.
    count = points.shape[0]
    durations, coefficients = np.empty(4 * count), np.zeros((4 * count, 3, 5))
    owners, times = np.empty(4 * count, dtype=np.int64), np.zeros(count)
    pieces, clock, first, rest = 0, 0.0, 0, np.zeros(3)
    entry_velocity, entry_acceleration = velocity, acceleration
    while first < count - 1:
        last = first + 1
        while last < count - 1 and rest_s[last] < 0.0:
            last += 1
        stage = points[first : last + 1]
        leg_s, blend_s, vertices = _durations(stage, caps[first:last], limits, entry_velocity, entry_acceleration, unwanted)
        velocities = _leg_velocities(vertices, leg_s, entry_velocity)
        if _norm(entry_velocity) + _norm(entry_acceleration) == 0.0:
            scale = _time_scale(leg_s, blend_s, velocities, caps[first:last], limits)
            leg_s, blend_s, velocities = leg_s * scale, blend_s * scale, velocities / scale
        center = clock + blend_s[0] / 2
        for k in range(last - first + 1):
            t = blend_s[k]
            start = points[first] if k == 0 else vertices[k] - velocities[k] * (t / 2)
            _fill_blend(
                coefficients[pieces], start, velocities[k], velocities[k + 1], entry_acceleration if k == 0 else rest, t
            )
            durations[pieces], owners[pieces] = t, 2 * (first + k)
            pieces += 1
            if k > 0:
                times[first + k] = center
            if k < last - first:
                cruise = leg_s[k] - (t + blend_s[k + 1]) / 2
                if cruise > 1e-9:
                    for axis in range(3):
                        coefficients[pieces, axis, 0] = vertices[k, axis] + velocities[k + 1, axis] * (t / 2)
                        coefficients[pieces, axis, 1] = velocities[k + 1, axis]
                    durations[pieces], owners[pieces] = cruise, 2 * (first + k) + 1
                    pieces += 1
                center += leg_s[k]
        clock = center + blend_s[last - first] / 2
        times[last] = clock
        if rest_s[last] > 0.0:
            for axis in range(3):
                coefficients[pieces, axis, 0] = points[last, axis]
            durations[pieces], owners[pieces] = rest_s[last], 2 * last
            pieces += 1
            clock += rest_s[last]
        first = last
        entry_velocity, entry_acceleration = rest, rest
    breakpoints = np.zeros(pieces + 1)
    for k in range(pieces):
        breakpoints[k + 1] = breakpoints[k] + durations[k]
    return breakpoints, coefficients[:pieces].copy(), times, owners[:pieces].copy()


@compiled_for(FREE_SPACE, FLOATS_1, FLOATS_3)
def first_outside(space: FreeSpace, breakpoints: FloatArray, coefficients: FloatArray) -> int:
    """Index of the first piece that leaves the bounds, or -1."""
    control = control_points(breakpoints, coefficients, coefficients.shape[2])
    for k in range(control.shape[0]):
        if least_margin(breakpoints[k : k + 2], control[k : k + 1], space.lower, space.upper)[0] < -GRAZING_M:
            return k
    return -1
