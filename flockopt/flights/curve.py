"""Curves: piecewise polynomials in time, and flights along them.

A curve is a callable: ``curve(t)`` is the position, ``curve(t, 1)`` the velocity and so on. Before its first
piece and after its last one it holds still, as a drone does in a plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike

from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray

__all__ = ["Curve", "Flight", "Visit"]


@dataclass(frozen=True, eq=False)
class Curve:
    """A piecewise polynomial in three axes.

    Attributes:
        breakpoints: (K + 1,) s, strictly increasing, the first >= 0.
        coefficients: (K, 3, D); ``coefficients[k, axis, n]`` multiplies ``(t - breakpoints[k]) ** n``.

    Raises:
        SettingsError: On wrong shapes, values that are not finite, or times that do not increase.
    """

    breakpoints: FloatArray  # (K + 1,) s
    coefficients: FloatArray  # (K, 3, D)

    def __post_init__(self) -> None:
        breakpoints = np.array(self.breakpoints, dtype=np.float64, order="C")
        coefficients = np.array(self.coefficients, dtype=np.float64, order="C")
        if coefficients.ndim != 3 or coefficients.shape[0] < 1 or coefficients.shape[1] != 3 or coefficients.shape[2] < 1:
            raise SettingsError("coefficients", f"has shape {coefficients.shape}", "must be (pieces, 3, terms)", "reshape it")
        if breakpoints.shape != (len(coefficients) + 1,):
            rule = f"must have shape ({len(coefficients) + 1},), one more than there are pieces"
            raise SettingsError("breakpoints", f"has shape {breakpoints.shape}", rule, "give every piece a start and an end")
        if not (np.isfinite(breakpoints).all() and np.isfinite(coefficients).all()):
            raise SettingsError("coefficients", "hold a NaN or an infinity", "must be finite", "check the planner")
        if breakpoints[0] < 0 or not (np.diff(breakpoints) > 0).all():
            raise SettingsError("breakpoints", "do not increase from >= 0", "must be strictly increasing", "sort them")
        for name, array in (("breakpoints", breakpoints), ("coefficients", coefficients)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def num_pieces(self) -> int:
        """K."""
        return len(self.coefficients)

    @property
    def start_time(self) -> float:
        """When it begins to move, seconds."""
        return float(self.breakpoints[0])

    @property
    def end_time(self) -> float:
        """When it comes to its end, seconds."""
        return float(self.breakpoints[-1])

    @property
    def duration(self) -> float:
        """Seconds from the first breakpoint to the last."""
        return self.end_time - self.start_time

    def __call__(self, t: ArrayLike, order: int = 0) -> FloatArray:
        """The derivative of the given order at times ``t``: (..., 3), in m/s**order.

        Outside its breakpoints the curve holds the nearest end position, with zero derivatives.
        """
        times = np.asarray(t, dtype=np.float64)
        flat = np.atleast_1d(times).ravel()
        inside = np.clip(flat, self.start_time, self.end_time)
        piece = np.clip(np.searchsorted(self.breakpoints, inside, side="right") - 1, 0, self.num_pieces - 1)
        local = inside - self.breakpoints[piece]
        coefficients = self._derivatives(order)[piece]  # (T, 3, D)
        values = np.zeros((len(flat), 3))
        for n in range(coefficients.shape[2] - 1, -1, -1):
            values = values * local[:, None] + coefficients[:, :, n]
        if order > 0:
            values[(flat < self.start_time) | (flat > self.end_time)] = 0.0
        return values.reshape(*times.shape, 3)

    def _derivatives(self, order: int) -> FloatArray:
        coefficients = self.coefficients
        for _ in range(order):
            powers = np.arange(1, coefficients.shape[2])
            coefficients = coefficients[:, :, 1:] * powers if len(powers) else np.zeros_like(coefficients)
        return coefficients

    @cached_property
    def length(self) -> float:
        """Metres flown: the integral of speed by 16-point Gauss-Legendre quadrature on each piece."""
        nodes, weights = _gauss_legendre(16)
        spans = np.diff(self.breakpoints)
        times = self.breakpoints[:-1, None] + spans[:, None] * (nodes + 1) / 2  # (K, 16)
        speeds = np.linalg.norm(self(times, 1), axis=-1)
        return float(np.sum(speeds @ weights * spans / 2))

    def shifted(self, seconds: float) -> Curve:
        """The same curve, flown later by ``seconds``."""
        return Curve(self.breakpoints + seconds, self.coefficients)

    def after(self, time: float) -> Curve | None:
        """What is left of the curve at ``time``, with that moment as its new zero; None if it has come to its end."""
        if time >= self.end_time:
            return None
        if time <= self.start_time:
            return self.shifted(-time)
        first = int(np.searchsorted(self.breakpoints, time, side="right")) - 1
        coefficients = self.coefficients[first:].copy()
        offset = time - self.breakpoints[first]
        for n in range(coefficients.shape[2] - 1):  # Taylor shift by synthetic division
            for k in range(coefficients.shape[2] - 2, n - 1, -1):
                coefficients[0, :, k] += offset * coefficients[0, :, k + 1]
        return Curve(np.concatenate([[0.0], self.breakpoints[first + 1 :] - time]), coefficients)

    def stretched(self, factor: float) -> Curve:
        """The same path, flown ``factor`` times slower."""
        powers = np.arange(self.coefficients.shape[2])
        return Curve(self.breakpoints * factor, self.coefficients / factor**powers)

    def at_most_degree(self, degree: int) -> bool:
        """Whether no piece has a term above the given degree."""
        return not self.coefficients[:, :, degree + 1 :].any()


@cache
def _gauss_legendre(num_nodes: int) -> tuple[FloatArray, FloatArray]:
    """Nodes in [-1, 1] and weights; finding them takes longer than using them."""
    return np.polynomial.legendre.leggauss(num_nodes)


@dataclass(frozen=True)
class Visit:
    """The task with id ``task`` is reached at ``time`` seconds."""

    task: str
    time: float


@dataclass(frozen=True)
class Flight:
    """What one drone flies: a curve and when it serves which task."""

    curve: Curve
    visits: tuple[Visit, ...] = ()

    def shifted(self, seconds: float) -> Flight:
        """The same flight, begun later by ``seconds``."""
        return Flight(self.curve.shifted(seconds), tuple(Visit(v.task, v.time + seconds) for v in self.visits))

    def then(self, other: Flight) -> Flight:
        """This flight to its end, and at once the other one, which begins at t = 0 where this one rests."""
        onward = other.shifted(self.curve.end_time)
        width = max(self.curve.coefficients.shape[2], onward.curve.coefficients.shape[2])
        pieces = [
            np.pad(curve.coefficients, ((0, 0), (0, 0), (0, width - curve.coefficients.shape[2])))
            for curve in (self.curve, onward.curve)
        ]
        breakpoints = np.concatenate([self.curve.breakpoints, onward.curve.breakpoints[1:]])
        return Flight(Curve(breakpoints, np.concatenate(pieces)), self.visits + onward.visits)
