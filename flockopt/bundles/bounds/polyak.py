"""Compiled: where the steps of a subgradient ascent aim, and how well they do.

Polyak's step (1969) is as long as would reach the maximum if the function were linear; the maximum is not known, so a
target stands in for it, a share of the best value above that. Where the target turns out too high, steps gain little,
and the share shrinks.
"""

from __future__ import annotations

import numpy as np
from numba import types

from flockopt.batches.compiled import FLOATS_1, compiled_for, writable
from flockopt.records.arrays import FloatArray

__all__ = ["BEST", "FIRST_REACH", "LEAST_REACH", "REACH", "aim", "begin"]

#: The target lies this share of the best value above it, at first and at least.
FIRST_REACH, LEAST_REACH = 0.05, 1e-5

#: The share shrinks after this many rounds that gain less than this part of it.
PATIENCE, LEAST_GAIN = 4, 0.1

#: How far an ascent has come, in an array: the highest value so far, the share by which the target lies above it, and the
#: rounds since the last one that gained enough.
BEST, REACH, STALE = 0, 1, 2


def begin(reach: float = FIRST_REACH) -> FloatArray:
    """Before the first value, with a target that lies this share above it."""
    return np.array([-np.inf, reach, 0.0])


@compiled_for(writable(FLOATS_1), *[types.float64] * 4)
def aim(ascent: FloatArray, value: float, cooling: float, least_reach: float, upper: float) -> float:
    """What the next step aims at after one more value; ``ascent`` is brought up to date.

    Args:
        ascent: (3,) as `begin` makes it.
        value: Of this round.
        cooling: What the reach is multiplied by when it has to shrink.
        least_reach: What it does not shrink below.
        upper: What the maximum is known not to pass.
    """
    best, reach = ascent[BEST], ascent[REACH]
    stale = 0.0 if value - best > LEAST_GAIN * reach * abs(best) else ascent[STALE] + 1.0
    if stale >= PATIENCE:
        reach, stale = max(cooling * reach, least_reach), 0.0
    best = max(value, best)
    ascent[BEST], ascent[REACH], ascent[STALE] = best, reach, stale
    return float(min(best * (1.0 + reach), max(upper, best)))
