"""How far a leg's pieces are from the spline they were fitted to: a bound that holds between samples.

Between two neighbours of the cuts (ends of pieces, times at control points) the difference of the two is one
polynomial of degree 15. Its values at 16 nodes give its Bernstein coefficients, and the difference lies in their hull.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from flockopt.flights.laws.catmull_rom import CatmullRom
from flockopt.records.arrays import FloatArray

__all__ = ["largest_error"]

#: Degree of a cubic under a quintic law.
DEGREE = 15

#: Halvings that find when a control point is passed.
HALVINGS = 52

#: Intervals shorter than this phase hold nothing but rounding.
SHORTEST = 1e-9


@lru_cache(maxsize=1)
def _nodes_and_hull() -> tuple[FloatArray, FloatArray]:
    """Chebyshev nodes (16,) in [0, 1], and the (16, 16) matrix from values there to Bernstein coefficients."""
    nodes = (1.0 - np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))) / 2
    orders = np.arange(DEGREE + 1)
    binomials = np.array([math.comb(DEGREE, order) for order in orders])
    basis = binomials * nodes[:, None] ** orders * (1.0 - nodes[:, None]) ** (DEGREE - orders)
    return nodes, np.asarray(np.linalg.inv(basis), dtype=np.float64)


def largest_error(curve: CatmullRom, leg: int, pieces: FloatArray, progress: Callable[[FloatArray], FloatArray]) -> float:
    """An upper bound in metres of the distance between a leg of the spline and its fit, at equal times.

    Args:
        curve: The spline.
        leg: Which of its legs.
        pieces: (P, 3, 8) power coefficients, each in its fraction of the leg's time.
        progress: The share of the leg's knots at a phase of its time, increasing.
    """
    count = len(pieces)
    cuts = np.union1d(np.arange(count + 1) / count, _phases(curve.knot_shares(leg), progress))
    cuts = np.concatenate([[0.0], cuts[1:][np.diff(cuts) > SHORTEST]])
    nodes, hull = _nodes_and_hull()
    phases = cuts[:-1, None] + np.diff(cuts)[:, None] * nodes  # (I, 16)
    spline = curve(np.full(phases.shape, leg), progress(phases))  # (I, 16, 3)
    piece = np.minimum(((cuts[:-1] + cuts[1:]) / 2 * count).astype(np.int64), count - 1)  # (I,)
    powers = (phases * count - piece[:, None])[..., None] ** np.arange(pieces.shape[2])  # (I, 16, 8)
    fitted = np.einsum("inp,iap->ina", powers, pieces[piece])
    return float(np.linalg.norm(hull @ (spline - fitted), axis=-1).max())


def _phases(shares: FloatArray, progress: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """The phases at which the law has made given shares of its progress, by bisection."""
    low, high = np.zeros(len(shares)), np.ones(len(shares))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        behind = progress(middle) < shares
        low, high = np.where(behind, middle, low), np.where(behind, high, middle)
    return np.asarray(high)
