"""A flight as stages, its rests and its ways by turns, each a chain of pieces between states.

The state at a joint is position, velocity and acceleration. One quintic leads from a state to another in a given time,
so that a chain of quintics is C2 whatever the states and times are: they are what there is to choose in smoothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np

from flockopt.flights import Curve, Flight, Visit
from flockopt.geometry.bernstein import control_points, piece_states
from flockopt.records.arrays import FloatArray

__all__ = ["TERMS", "Stage", "hermite", "join", "split", "squared_jerk"]

#: Coefficients of a quintic.
TERMS = 6

#: A piece whose control points are no farther apart is a rest, metres.
REST_M = 1e-9

#: Speeds and accelerations this small are none, m/s and m/s2.
AT_REST = 1e-9

#: Pieces this much shorter than a neighbour are slivers: their derivatives depend on their duration beyond all measure.
SLIVER_SHARE = 0.1


def hermite() -> tuple[FloatArray, FloatArray]:
    """Control points of a quintic from the states at its ends.

    Returns:
        Two matrices (6, 3), for (p, T v, T**2 a) at the beginning and at the end; the control points are their sum.
    """
    begin = np.array([[1.0, 0.0, 0.0], [1.0, 0.2, 0.0], [1.0, 0.4, 0.05], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return begin, begin[::-1] * np.array([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Stage:
    """Some pieces of a flight, between two rests, or a rest.

    Attributes:
        durations: (K,) s.
        states: (K + 1, 3, 3), the position, velocity and acceleration at every joint.
        visits: Of every visit in it: the piece, the phase of the piece (0 to 1), the index among the flight's visits.
        given: (K, 3, D), the power coefficients it came with; None for the quintics between its states.
    """

    durations: FloatArray
    states: FloatArray
    visits: tuple[tuple[int, float, int], ...]
    given: FloatArray | None = None

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return float(self.durations.sum())

    @property
    def starts_at_rest(self) -> bool:
        """Whether it begins at rest; then it may be flown slower."""
        return bool(np.abs(self.states[0, 1:]).max() <= AT_REST)

    @property
    def rests(self) -> bool:
        """Whether it does not move at all."""
        return self.given is not None and bool(np.abs(self.given[:, :, 1:]).max(initial=0.0) == 0.0)

    @cached_property
    def breakpoints(self) -> FloatArray:
        """(K + 1,) s from 0."""
        return np.concatenate([[0.0], np.cumsum(self.durations)])

    @cached_property
    def control(self) -> FloatArray:
        """Control points of the quintics between its states, (K, 3, 6) m."""
        begin, end = hermite()
        powers = self.durations[:, None, None] ** np.arange(3)[:, None]  # (K, 3, 1)
        control = begin @ (self.states[:-1] * powers) + end @ (self.states[1:] * powers)  # (K, 6, 3)
        return np.ascontiguousarray(control.transpose(0, 2, 1))

    @cached_property
    def coefficients(self) -> FloatArray:
        """Power coefficients, (K, 3, D)."""
        if self.given is not None:
            return self.given
        differences, result = self.control, np.empty(self.control.shape)
        for n, binomial in enumerate((1.0, 5.0, 10.0, 10.0, 5.0, 1.0)):
            result[:, :, n] = binomial * differences[:, :, 0] / self.durations[:, None] ** n
            differences = np.diff(differences, axis=2)
        return result

    @cached_property
    def squared_jerk(self) -> float:
        """Integral of the squared jerk, m2/s5."""
        return squared_jerk(self.breakpoints, self.coefficients)

    def slowed(self, factor: float) -> Stage:
        """The quintics between its states, flown ``factor`` times slower."""
        scale = factor ** -np.arange(3.0)
        return replace(self, durations=self.durations * factor, states=self.states * scale[:, None], given=None)

    def without_slivers(self) -> Stage:
        """Quintics between its states, with slivers on which nothing is visited made part of their shorter neighbour."""
        stage = replace(self, given=None)
        while len(stage.durations) > 1:
            padded = np.concatenate([[np.inf], stage.durations, [np.inf]])
            neighbours = np.minimum(padded[:-2], padded[2:])
            shares = stage.durations / neighbours
            shares[[piece for piece, _, _ in stage.visits]] = np.inf
            sliver = int(shares.argmin())
            if shares[sliver] > SLIVER_SHARE:
                break
            stage = stage._merged(sliver if padded[sliver + 2] < padded[sliver] else sliver - 1)
        return stage

    def _merged(self, first: int) -> Stage:
        """One piece in place of ``first`` and its successor."""
        share = self.durations[first] / self.durations[first : first + 2].sum()
        visits = []
        for piece, phase, index in self.visits:
            if piece == first:
                phase *= share
            elif piece == first + 1:
                phase = share + (1.0 - share) * phase
            visits.append((piece - (piece > first), phase, index))
        durations = np.delete(self.durations, first)
        durations[first] += self.durations[first]
        return replace(self, durations=durations, states=np.delete(self.states, first + 1, axis=0), visits=tuple(visits))


def squared_jerk(breakpoints: FloatArray, coefficients: FloatArray) -> float:
    """Integral of the squared jerk of a curve over its whole time, m2/s5, in closed form.

    Args:
        breakpoints: (K + 1,) s.
        coefficients: (K, 3, D).
    """
    n = np.arange(3, coefficients.shape[2])
    jerk = coefficients[:, :, 3:] * (n * (n - 1) * (n - 2))  # (K, 3, D - 3)
    powers = n[:, None] + n - 5  # of the time in the integral of a product of two terms
    integrals = np.diff(breakpoints)[:, None, None] ** powers / powers
    return float(np.einsum("kai,kij,kaj->", jerk, integrals, jerk))


def split(flight: Flight) -> list[Stage]:
    """The stages of a flight, rests and ways by turns."""
    curve = flight.curve
    rests = np.ptp(control_points(curve.breakpoints, curve.coefficients, 8), axis=2).max(axis=1) <= REST_M
    firsts, lasts = piece_states(curve.breakpoints, curve.coefficients)
    places = [_place(curve, visit) for visit in flight.visits]
    stages = []
    for rest, group in groupby(range(curve.num_pieces), key=lambda piece: bool(rests[piece])):
        pieces = list(group)
        given = (
            curve.coefficients[pieces] * (np.arange(curve.coefficients.shape[2]) == 0) if rest else curve.coefficients[pieces]
        )
        visits = [(piece - pieces[0], phase, index) for index, (piece, phase) in enumerate(places) if piece in pieces]
        states = np.concatenate([firsts[pieces], lasts[pieces[-1:]]])
        stages.append(Stage(np.diff(curve.breakpoints)[pieces], states, tuple(visits), given))
    return stages


def _place(curve: Curve, visit: Visit) -> tuple[int, float]:
    """The piece a visit is on and the phase of it."""
    time = min(max(visit.time, curve.start_time), curve.end_time)
    piece = min(int(np.searchsorted(curve.breakpoints, time, side="right")) - 1, curve.num_pieces - 1)
    begin, end = curve.breakpoints[piece : piece + 2]
    return piece, float((time - begin) / (end - begin))


def join(flight: Flight, stages: Sequence[Stage]) -> Flight:
    """The flight with its stages replaced by others between the same places."""
    durations = np.concatenate([stage.durations for stage in stages])
    breakpoints = flight.curve.start_time + np.concatenate([[0.0], np.cumsum(durations)])
    coefficients = np.zeros((len(durations), 3, max(stage.coefficients.shape[2] for stage in stages)))
    times, first = {}, 0
    for stage in stages:
        own = slice(first, first + len(stage.durations))
        coefficients[own, :, : stage.coefficients.shape[2]] = stage.coefficients
        for piece, phase, index in stage.visits:
            begin, end = breakpoints[own][piece], breakpoints[1:][own][piece]
            times[index] = float(begin + phase * (end - begin) if phase < 1.0 else end)
        first = own.stop
    visits = tuple(replace(visit, time=times[index]) for index, visit in enumerate(flight.visits))
    return Flight(Curve(breakpoints, coefficients), visits)
