"""Fitting a path sampled over time by few polynomial pieces of degree 7 that join smoothly.

Equality-constrained least squares: the pieces share the time evenly; position, velocity and acceleration are
continuous, the ends are met exactly, and velocity and acceleration are zero there. All of that is linear in the
samples, and the matrix depends on nothing but the number of pieces, so that a fit is one product.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial, chebyshev
from numpy.typing import NDArray

from flockopt.records.arrays import FloatArray

__all__ = ["FIT_TERMS", "fit_operator", "fit_phases"]

#: Coefficients of a piece: degree 7, what a Crazyflie flies.
FIT_TERMS = 8

#: Samples a piece is fitted to, at Chebyshev nodes.
SAMPLES_A_PIECE = 12

#: Derivatives that are continuous, and zero at both ends where they are not the position.
SMOOTHNESS = 3


@lru_cache(maxsize=64)
def fit_phases(num_pieces: int) -> FloatArray:
    """(S,) times in [0, 1] to sample the path at: 0, nodes within every piece, 1."""
    nodes = (1.0 - np.cos(np.pi * (np.arange(SAMPLES_A_PIECE) + 0.5) / SAMPLES_A_PIECE)) / 2
    inner = (np.arange(num_pieces)[:, None] + nodes) / num_pieces
    return np.concatenate([[0.0], inner.ravel(), [1.0]])


@lru_cache(maxsize=64)
def fit_operator(num_pieces: int) -> FloatArray:
    """(P * 8, S) what turns samples at `fit_phases` into the power coefficients of P pieces.

    Coefficients are in the fraction of a piece, which runs from 0 to 1; row ``8 p + n`` gives the n-th one of piece p.
    """
    phases = fit_phases(num_pieces) * num_pieces
    piece = np.minimum(phases.astype(np.int64), num_pieces - 1)
    design = _rows(num_pieces, piece, phases - piece, 0)  # (S, P * 8)
    constraints, wanted = _constraints(num_pieces, len(phases))
    # All solutions of the constraints are one of them plus the null space, in which least squares are free.
    num_rows = len(constraints)
    basis, upper = np.linalg.qr(constraints.T, mode="complete")
    particular = basis[:, :num_rows] @ np.linalg.solve(upper[:num_rows].T, wanted)
    free = basis[:, num_rows:]
    rest = np.linalg.lstsq(design @ free, np.eye(len(phases)) - design @ particular, rcond=None)[0]
    series = (particular + free @ rest).reshape(num_pieces, FIT_TERMS, len(phases))
    return np.ascontiguousarray((_powers_of_series() @ series).reshape(num_pieces * FIT_TERMS, len(phases)))


def _rows(num_pieces: int, piece: NDArray[np.int64], fraction: FloatArray, order: int) -> FloatArray:
    """(R, P * 8) derivatives at fractions of given pieces, by Chebyshev coefficients of all pieces."""
    units = np.eye(FIT_TERMS)
    # The series live on [-1, 1], twice as wide as a piece: every derivative brings a factor of two.
    values = 2.0**order * chebyshev.chebval(2 * fraction - 1, chebyshev.chebder(units, order)).T  # (R, 8)
    rows = np.zeros((len(piece), num_pieces, FIT_TERMS))
    rows[np.arange(len(piece)), piece] = values
    return rows.reshape(len(piece), num_pieces * FIT_TERMS)


def _constraints(num_pieces: int, num_samples: int) -> tuple[FloatArray, FloatArray]:
    """Left sides (R, P * 8) and right sides (R, S), by samples, of what holds exactly."""
    before, after = np.arange(num_pieces - 1), np.arange(1, num_pieces)
    ends, end_fractions = np.array([0, num_pieces - 1]), np.array([0.0, 1.0])
    left, right = [], []
    for order in range(SMOOTHNESS):
        left.append(_rows(num_pieces, ends, end_fractions, order))
        right.append(np.zeros((2, num_samples)))
        if order == 0:
            right[-1][[0, 1], [0, -1]] = 1.0
        joints = np.ones(num_pieces - 1), np.zeros(num_pieces - 1)
        left.append(_rows(num_pieces, before, joints[0], order) - _rows(num_pieces, after, joints[1], order))
        right.append(np.zeros((num_pieces - 1, num_samples)))
    return np.vstack(left), np.vstack(right)


def _powers_of_series() -> FloatArray:
    """(8, 8) power coefficients on [0, 1] of the Chebyshev polynomials on [-1, 1], one a column."""
    matrix = np.zeros((FIT_TERMS, FIT_TERMS))
    for n in range(FIT_TERMS):
        powers = Polynomial(chebyshev.cheb2poly(np.eye(FIT_TERMS)[n, : n + 1]))(Polynomial([-1.0, 2.0])).coef
        matrix[: len(powers), n] = powers
    return matrix
