"""Centripetal Catmull-Rom curves through the control points of many legs at once.

The knots are spaced by the square root of the distance between control points (centripetal: no loops or cusps
within a span, Yuksel, Schaefer and Keyser, "Parameterization and applications of Catmull-Rom curves", 2011). The
curve is C1 in that parameter, a cubic between two control points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flockopt.records.arrays import FloatArray

__all__ = ["CatmullRom"]


@dataclass(frozen=True, eq=False)
class CatmullRom:
    """Curves along legs, each from its first control point to its last.

    Attributes:
        points: (P, 3) m, the control points of all legs, one leg after another, both its ends included; consecutive
            ones of a leg apart.
        first: (L + 1,) where each leg's points begin, and P.
        joined: (L,) whether a leg goes on where the one before it ends, in one curve.
    """

    points: FloatArray  # (P, 3) m
    first: NDArray[np.int64]  # (L + 1,)
    joined: NDArray[np.bool_]  # (L,)

    @cached_property
    def knots(self) -> FloatArray:
        """(P,) the curve parameter at every control point; legs lie one apart on its axis."""
        steps = np.empty(len(self.points))
        steps[0] = 0.0
        steps[1:] = np.sqrt(np.linalg.norm(np.diff(self.points, axis=0), axis=1))
        steps[self.first[1:-1]] = 1.0
        return np.cumsum(steps)

    @cached_property
    def slopes(self) -> FloatArray:
        """(P, 3) the derivative at every control point; at a loose end that of its span's chord."""
        points, begins, ends = self.points, self.first[:-1], self.first[1:] - 1
        before, after = np.empty_like(points), np.empty_like(points)
        before[1:], after[:-1] = points[:-1], points[1:]
        # A leg's first point is the last one of the leg before it: its neighbour there is one farther back.
        going_on = begins[self.joined]
        before[going_on] = points[going_on - 2]
        after[going_on - 1] = points[going_on + 1]
        loose_begins, loose_ends = begins[~self.joined], ends[~np.append(self.joined[1:], False)]
        before[loose_begins] = 2 * points[loose_begins] - points[loose_begins + 1]
        after[loose_ends] = 2 * points[loose_ends] - points[loose_ends - 1]
        arriving, leaving = points - before, after - points
        step_in = np.sqrt(np.linalg.norm(arriving, axis=1))[:, None]
        step_out = np.sqrt(np.linalg.norm(leaving, axis=1))[:, None]
        return arriving / step_in + leaving / step_out - (after - before) / (step_in + step_out)

    @cached_property
    def _cubics(self) -> FloatArray:
        """(4, P - 1, 3) power coefficients of every span in its fraction; those between legs are not used."""
        step = np.diff(self.knots)[:, None]
        chord, leaving, arriving = np.diff(self.points, axis=0), self.slopes[:-1] * step, self.slopes[1:] * step
        return np.stack([self.points[:-1], leaving, 3 * chord - 2 * leaving - arriving, leaving + arriving - 2 * chord])

    def __call__(self, legs: NDArray[np.int64], share: FloatArray) -> FloatArray:
        """Positions (..., 3) m on given legs at given shares of their knots, 0 to 1; both of one shape."""
        begins, ends = self.first[legs], self.first[legs + 1] - 1
        knots = self.knots
        parameter = knots[begins] + share * (knots[ends] - knots[begins])
        span = np.clip(np.searchsorted(knots, parameter, side="right") - 1, begins, ends - 1)
        fraction = ((parameter - knots[span]) / (knots[span + 1] - knots[span]))[..., None]
        constant, linear, square, cube = self._cubics[:, span]
        return constant + fraction * (linear + fraction * (square + fraction * cube))

    def knot_shares(self, leg: int) -> FloatArray:
        """(K + 1,) the share of a leg's knots at each of its control points, from 0 to 1."""
        knots = self.knots[self.first[leg] : self.first[leg + 1]]
        return (knots - knots[0]) / (knots[-1] - knots[0])
