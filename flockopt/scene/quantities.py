"""What the numbers of a scene may be: as large and as small as floating point bears, and in the unit that is meant."""

from __future__ import annotations

import math
from typing import Any

from flockopt.errors import SceneError
from flockopt.records import checks

__all__ = [
    "LARGEST_COORDINATE_M", "LARGEST_SIDE_M", "MOST_DEMAND", "angle", "load", "measure", "place", "positive", "seconds",
    "width",
]  # fmt: skip

#: Sizes, limits and distances lie between these, in SI units: the judge's tolerances (1e-6) decide below, rounding above.
SMALLEST, LARGEST = 1e-6, 1e9

#: Coordinates reach as far as this: there they are 1.5e-8 m apart, which leaves the judge's tolerances (1e-6 m) whole. Every
#: projected coordinate on Earth is nearer to zero (web Mercator's reach 2e7, eastings with a zone before them 6.1e7).
LARGEST_COORDINATE_M = 1e8

#: A fleet's space is at most this long, wide and high: seen from its middle (`flockopt.scene.frame.Frame`) no curve within it
#: reaches as far as the judge follows, 1e6 m.
LARGEST_SIDE_M = 1e6

#: The longest that one task may take, seconds: times are told apart to 1e-9 s, also after many of these.
LONGEST_SERVICE_S = 1e6

#: Whole numbers up to this, and their sums, are exact in every solver.
MOST_DEMAND = 2**53

#: Angles go once around at most, and a little more for who writes 2 pi with three decimals.
LARGEST_ANGLE = 2.0 * math.pi + 1e-3

BEYOND = "correct it; was it given in another unit?"


def positive(error: type[SceneError], field: str, value: Any, *, mend: str = "") -> float:
    """A number above zero that is no larger than `LARGEST`."""
    result = checks.number(error, field, value, above=0.0, mend=mend)
    return checks.number(error, field, result, most=LARGEST, mend=BEYOND)


def measure(error: type[SceneError], field: str, value: Any) -> float:
    """A number above zero, from `SMALLEST` to `LARGEST`."""
    return checks.number(error, field, positive(error, field, value), least=SMALLEST, mend=BEYOND)


def width(error: type[SceneError], field: str, value: Any) -> float:
    """Room that is to be kept: none, or a `measure`."""
    result = checks.number(error, field, value, least=0.0)
    return measure(error, field, result) if result > 0.0 else result


def seconds(error: type[SceneError], field: str, value: Any) -> float:
    """How long something takes, from 0 to `LONGEST_SERVICE_S`."""
    result = checks.number(error, field, value, least=0.0)
    return checks.number(error, field, result, most=LONGEST_SERVICE_S, mend="give it in seconds")


def place(error: type[SceneError], field: str, value: Any) -> tuple[float, float, float]:
    """A point whose coordinates are within `LARGEST_COORDINATE_M` of zero."""
    point = checks.point(error, field, value)
    for axis, coordinate in enumerate(point):
        if abs(coordinate) > LARGEST_COORDINATE_M:
            rule = f"coordinates lie within {LARGEST_COORDINATE_M:g} m of zero: farther off, rounding decides"
            raise error(f"{field}[{axis}]", f"is {coordinate:g}", rule, "subtract an offset from all of them")
    return point


def angle(error: type[SceneError], field: str, value: Any) -> float:
    """Radians, once around at most: what is beyond was meant in degrees."""
    result = checks.number(error, field, value)
    if abs(result) > LARGEST_ANGLE:
        raise error(field, f"is {result:g}", "must be within [-2 pi, 2 pi]", "give it in radians; did you mean degrees?")
    return result


def load(error: type[SceneError], field: str, value: Any, *, least: int, mend: str = "") -> int:
    """A whole number that a drone carries or a task demands, at most `MOST_DEMAND`."""
    result = checks.integer(error, field, value, least=least, mend=mend)
    return checks.integer(error, field, result, least=least, most=MOST_DEMAND, mend="count in larger units")
