"""Compiled: polylines thinned and measured."""

from __future__ import annotations

import math

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_2, compiled_for, compiled_lazily
from flockopt.geometry.kernels import segment_length
from flockopt.records.arrays import FloatArray

__all__ = ["polyline_length", "thinned"]


@compiled_for(FLOATS_2, types.float64)
def thinned(points: FloatArray, tolerance: float) -> FloatArray:
    """The polyline (V, 3) m without vertices closer than ``tolerance`` to it (Ramer 1972, Douglas and Peucker 1973).

    From its chord on, the vertex farthest from the line so far is taken in until all are near it: what is left out is
    near the segment that takes its place, not only near some part of the line.
    """
    kept = np.zeros(len(points), dtype=np.bool_)
    kept[0] = kept[-1] = True
    pending = [(0, len(points) - 1)]
    while len(pending) > 0:
        first, last = pending.pop()
        worst, gap = _farthest_from_chord(points, first, last)
        if gap > tolerance:
            kept[worst] = True
            pending.append((first, worst))
            pending.append((worst, last))
    return points[kept]


@compiled_lazily()
def _farthest_from_chord(points: FloatArray, first: int, last: int) -> tuple[int, float]:
    """The vertex between two others that is farthest from their chord, and how far it is, metres; -1 without any."""
    chord = points[last] - points[first]
    square = max(_dot(chord, chord), 1e-12)
    worst, most = -1, -1.0
    for index in range(first + 1, last):
        offset = points[index] - points[first]
        away = offset - min(max(_dot(offset, chord) / square, 0.0), 1.0) * chord
        gap = math.sqrt(_dot(away, away))
        if gap > most:
            worst, most = index, gap
    return worst, most


@compiled_lazily()
def _dot(a: FloatArray, b: FloatArray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled_lazily()
def polyline_length(points: FloatArray) -> float:
    """Metres of a polyline (V, 3)."""
    total = 0.0
    for index in range(len(points) - 1):
        total += segment_length(points[index], points[index + 1])
    return total
