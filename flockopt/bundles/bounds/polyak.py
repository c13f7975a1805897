"""Compiled: where the steps of a subgradient ascent aim, and how well they do.

Polyak's step (1969) is as long as would reach the maximum if the function were linear; the maximum is not known, so a
target stands in for it, a share of the best value above that. Where the target turns out too high, steps gain little,
and the share shrinks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from flockopt.batches.compiled import compiled_for, record_of

__all__ = ["LEAST_REACH", "Ascent", "begin", "seen", "target"]

#: The target lies this share of the best value above it, at first and at least.
FIRST_REACH, LEAST_REACH = 0.05, 1e-5

#: The share shrinks after this many rounds that gain less than this part of it.
PATIENCE, LEAST_GAIN = 4, 0.1


class Ascent(NamedTuple):
    """How far an ascent has come."""

    best: float  # the highest value so far
    reach: float  # the share by which the target lies above it
    stale: int  # rounds since the last one that gained enough


#: The record's type in compiled signatures.
ASCENT = record_of(Ascent, types.float64, types.float64, types.int64)


@compiled_for()
def begin() -> Ascent:
    """Before the first value."""
    return Ascent(-np.inf, FIRST_REACH, 0)


@compiled_for(ASCENT, types.float64, types.float64, types.float64)
def seen(ascent: Ascent, value: float, cooling: float, least_reach: float) -> Ascent:
    """After one more value; a reach that has to shrink is multiplied by ``cooling``, and is ``least_reach`` at least."""
    best, reach = ascent.best, ascent.reach
    stale = 0 if value - best > LEAST_GAIN * reach * abs(best) else ascent.stale + 1
    if stale >= PATIENCE:
        reach, stale = max(cooling * reach, least_reach), 0
    return Ascent(max(value, best), reach, stale)


@compiled_for(ASCENT, types.float64)
def target(ascent: Ascent, upper: float) -> float:
    """What the next step aims at; not above ``upper``, which the maximum is known not to pass."""
    return min(ascent.best * (1.0 + ascent.reach), max(upper, ascent.best))
