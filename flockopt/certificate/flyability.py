"""What a flight asks of a drone's rotors: the largest thrust and tilt, over all time.

A drone that accelerates by a has thrust mass * (a + g e_z), along its own upward axis; its yaw is free (Mellinger and
Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011). Both are polynomials' business: the
square of |a + g e_z| is one, and the tangent of the tilt, squared, is the ratio of two.
"""

from __future__ import annotations

import math

import numpy as np

from flockopt.certificate.case import JudgedCase, Worst
from flockopt.certificate.certificate import FLYABILITY, Clause
from flockopt.geometry.bernstein import EXTREME_TOLERANCE, SMALL_SQUARE, derivative, largest_value, squared_norm
from flockopt.records.arrays import FloatArray
from flockopt.scene.scene import GRAVITY_MPS2

__all__ = ["judge_flyability", "largest_thrust", "largest_tilt"]

#: The largest tilt is found to this fraction of its tangent, squared.
TILT_TOLERANCE = 1e-10

#: Upward accelerations below this, metres per second squared, leave no thrust to lean on.
LEAST_UPWARD_MPS2 = 1e-6


def judge_flyability(case: JudgedCase, tolerance: float) -> Clause:
    """Whether the drones whose mass, thrust or tilt the scene gives can fly as the plan asks, within a fraction of each."""
    worst, thrusts, tilts = Worst(), [GRAVITY_MPS2], [0.0]
    for i, drone in enumerate(case.scene.drones):
        if not drone.has_abilities:
            continue
        thrust, thrust_time = largest_thrust(case.curves[i][0], case.controls[i])
        tilt, tilt_time = largest_tilt(case.curves[i][0], case.controls[i])
        thrusts.append(thrust)
        tilts.append(tilt)
        if drone.mass is not None and drone.max_thrust is not None:
            force = drone.mass * thrust
            detail = f"drone {drone.id} needs a thrust of {force:.6g} N; its max_thrust is {drone.max_thrust:g} N"
            place = case.place(i, thrust_time)
            worst.see(1.0 - force / drone.max_thrust, drone=drone.id, time=thrust_time, place=place, detail=detail)
        if drone.max_tilt is not None:
            detail = f"drone {drone.id} tilts by {tilt:.6g} rad; its max_tilt is {drone.max_tilt:g} rad"
            place = case.place(i, tilt_time)
            worst.see(1.0 - tilt / drone.max_tilt, drone=drone.id, time=tilt_time, place=place, detail=detail)
    ratio, degrees = max(thrusts) / GRAVITY_MPS2, math.degrees(max(tilts))
    note = f"thrust is at most {ratio:.3g} times the weight, tilt at most {degrees:.3g} degrees"
    return worst.clause(FLYABILITY, "fraction", tolerance, note)


def largest_thrust(breakpoints: FloatArray, control: FloatArray) -> tuple[float, float]:
    """The largest thrust for each kilogram over a whole curve.

    Args:
        breakpoints: (K + 1,) s.
        control: (K, 3, D) m, control points of the pieces.

    Returns:
        m/s**2, an upper bound tight to rounding (g at rest), and the time of it in seconds.
    """
    best, time = GRAVITY_MPS2**2, float(breakpoints[0])  # before and after its pieces a drone rests
    for k, thrust in _thrusts(breakpoints, control):
        square, where = largest_value(squared_norm(thrust), best, SMALL_SQUARE)
        if where >= 0.0:
            best, time = square, _moment(breakpoints, k, where)
    return math.sqrt(best), time


def largest_tilt(breakpoints: FloatArray, control: FloatArray) -> tuple[float, float]:
    """The largest angle of the thrust from upright over a whole curve; arguments as in `largest_thrust`.

    The largest ratio r of two polynomials N / D, D > 0, is the one for which N - r D has the largest value 0; each ratio
    where N - r D is largest is nearer to it (Dinkelbach, "On nonlinear fractional programming", 1967).

    Returns:
        Radians, an upper bound tight to `TILT_TOLERANCE`, and the time of it in seconds. Where the thrust is not upward,
        pi and that time.
    """
    ratio, time = 0.0, float(breakpoints[0])
    for k, thrust in _thrusts(breakpoints, control):
        downward, where = largest_value(-thrust[2], -np.inf, 1.0)
        if downward > -LEAST_UPWARD_MPS2:
            return math.pi, _moment(breakpoints, k, where)
        level, upward = thrust.copy(), np.zeros_like(thrust)
        level[2], upward[2] = 0.0, thrust[2]
        above, below = squared_norm(level), squared_norm(upward)
        smallest = downward * downward
        small = smallest * TILT_TOLERANCE / EXTREME_TOLERANCE
        while True:
            excess, where = largest_value(above - ratio * below, 0.0, small)
            here = _value(above, where) / _value(below, where) if where >= 0.0 else ratio
            if here > ratio * (1.0 + TILT_TOLERANCE):
                ratio, time = here, _moment(breakpoints, k, where)
            else:
                ratio += excess / smallest  # what the search leaves open, on the safe side
                break
    return math.atan(math.sqrt(ratio)), time


def _thrusts(breakpoints: FloatArray, control: FloatArray) -> list[tuple[int, FloatArray]]:
    """Every piece's number and the control points (3, D - 2) of a + g e_z, m/s**2."""
    spans = np.diff(breakpoints)
    return [(k, derivative(piece, spans[k], 2) + np.array([[0.0], [0.0], [GRAVITY_MPS2]])) for k, piece in enumerate(control)]


def _moment(breakpoints: FloatArray, k: int, where: float) -> float:
    return float(breakpoints[k] + where * (breakpoints[k + 1] - breakpoints[k]))


def _value(control: FloatArray, where: float) -> float:
    """A polynomial's value at a fraction of its interval, by de Casteljau's rule."""
    points = control
    while len(points) > 1:
        points = points[:-1] + where * (points[1:] - points[:-1])
    return float(points[0])
