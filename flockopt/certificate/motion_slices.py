"""Motions cut into slices, for the second judge: where a drone can be during a slice of time, in numpy alone.

A slice holds its polynomial in powers of the time since its own middle, so that the terms' sizes bound how far the
motion strays from there (a centred Taylor form). Nothing here is shared with `flockopt.geometry.bernstein` or
`flockopt.geometry.continuous`: the two judges must not err together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flockopt.flights import Curve
from flockopt.records.arrays import FloatArray
from flockopt.scene import Point

__all__ = ["SLICES_PER_PIECE", "Motion", "Slices", "motion", "relative_slices", "slices", "taylor_shift"]

#: A piece cut into this many slices has high terms too small to matter in a slice.
SLICES_PER_PIECE = 8

_POWERS = np.arange(16)
_BINOMIAL = np.array([[math.comb(int(k), int(n)) for k in _POWERS] for n in _POWERS], dtype=np.float64)
_EXPONENT = np.maximum(_POWERS[None, :] - _POWERS[:, None], 0)


@dataclass(frozen=True)
class Motion:
    """Where a drone is, from t = 0 until the last drone of the plan has finished.

    Attributes:
        times: (K + 1,) s, rising from 0.
        terms: (K, 3, D), of powers of the time since the piece began.
    """

    times: FloatArray
    terms: FloatArray


@dataclass(frozen=True)
class Slices:
    """Parts of a motion.

    Attributes:
        middles: (S,) s.
        halves: (S,) s, half of each slice's duration.
        terms: (S, 3, D), of powers of the time since the slice's middle.
    """

    middles: FloatArray
    halves: FloatArray
    terms: FloatArray

    def boxes(self) -> FloatArray:
        """Axis-aligned boxes that the slices stay in, (S, 2, 3)."""
        powers = self.halves[:, None] ** np.arange(1, self.terms.shape[2])  # (S, D - 1)
        reach = np.einsum("sad,sd->sa", np.abs(self.terms[:, :, 1:]), powers)
        return np.stack([self.terms[:, :, 0] - reach, self.terms[:, :, 0] + reach], axis=1)


def motion(curve: Curve | None, start: Point, end_time: float) -> Motion:
    """A drone's whole motion: its curve, and rest before and after it; rest at ``start`` without a curve.

    Args:
        curve: What it flies, or None.
        start: Metres, where it is at t = 0.
        end_time: Seconds, when the last drone has finished.
    """
    if curve is None:
        return Motion(np.array([0.0, max(end_time, 1.0)]), np.array(start, dtype=np.float64).reshape(1, 3, 1))
    times, terms = [curve.breakpoints], [curve.coefficients]
    resting = np.zeros((1, 3, curve.coefficients.shape[2]))
    if curve.start_time > 0.0:
        resting[0, :, 0] = curve(curve.start_time)
        times.insert(0, np.zeros(1))
        terms.insert(0, resting.copy())
    if curve.end_time < end_time:
        resting[0, :, 0] = curve(curve.end_time)
        times.append(np.array([end_time]))
        terms.append(resting)
    return Motion(np.concatenate(times), np.concatenate(terms))


def slices(whole: Motion) -> Slices:
    """A motion in `SLICES_PER_PIECE` slices a piece."""
    middles, halves = _cut(whole.times)
    return Slices(middles, halves, _terms_about(whole, middles))


def relative_slices(one: Motion, other: Motion, axes: FloatArray) -> Slices:
    """Where ``one`` is as seen from ``other``, in units of ``axes`` (3,) m, while both last."""
    end = min(one.times[-1], other.times[-1])
    times = np.unique(np.concatenate([one.times, other.times]))
    middles, halves = _cut(times[times <= end])
    first, second = _terms_about(one, middles), _terms_about(other, middles)
    terms = np.zeros((len(middles), 3, max(first.shape[2], second.shape[2])))
    terms[:, :, : first.shape[2]] += first
    terms[:, :, : second.shape[2]] -= second
    return Slices(middles, halves, terms / axes[:, None])


def taylor_shift(terms: FloatArray, by: float) -> FloatArray:
    """The polynomials (..., D) in powers of the time since ``by`` seconds later."""
    size = terms.shape[-1]
    weights: FloatArray = _BINOMIAL[:size, :size] * by ** _EXPONENT[:size, :size]
    shifted: FloatArray = terms @ weights.T
    return shifted


def _cut(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middles and half durations (S,) of `SLICES_PER_PIECE` slices between any two times."""
    quarter = np.diff(times)[:, None] / (2 * SLICES_PER_PIECE)
    middles = times[:-1, None] + quarter * (2 * np.arange(SLICES_PER_PIECE) + 1)
    return middles.ravel(), np.broadcast_to(quarter, middles.shape).ravel()


def _terms_about(whole: Motion, middles: FloatArray) -> FloatArray:
    """Terms (S, 3, D) of powers of the time since each of the middles, by Horner's scheme for Taylor shifts."""
    piece = np.clip(np.searchsorted(whole.times, middles, side="right") - 1, 0, len(whole.terms) - 1)
    terms, since = whole.terms[piece].copy(), (middles - whole.times[piece])[:, None]
    size = terms.shape[2]
    for lowest in range(size - 1):
        for power in range(size - 2, lowest - 1, -1):
            terms[:, :, power] += since * terms[:, :, power + 1]
    return terms
