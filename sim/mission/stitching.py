"""One flight of the pieces of several: what a drone was to fly while plans took turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flockopt.flights import Curve, Flight
from flockopt.records.arrays import FloatArray

__all__ = ["Leg", "stitched"]

#: Pieces shorter than this are left out, seconds.
SHORTEST_PIECE_S = 1e-9


@dataclass(frozen=True)
class Leg:
    """A drone's part in one plan.

    Attributes:
        flight: What it flies, on the plan's clock; None where it is parked.
        begin_s: When the plan's clock starts, on the clock of the whole.
        until_s: Until when the plan is followed, likewise; infinite for the last.
    """

    flight: Flight | None
    begin_s: float = 0.0
    until_s: float = np.inf


def stitched(legs: Sequence[Leg]) -> Flight | None:
    """The legs, one after another, on one clock; None if the drone is parked in all of them."""
    first = legs[0]
    if len(legs) == 1 and first.flight is not None and first.begin_s == 0.0 and first.until_s >= first.flight.curve.end_time:
        return first.flight
    times: list[float] = []  # of each piece, begin and end
    terms: list[FloatArray] = []
    visits = []
    for leg in legs:
        if leg.flight is None:
            continue
        curve = leg.flight.curve
        for piece, coefficients in enumerate(curve.coefficients):
            begin, end = leg.begin_s + curve.breakpoints[piece], min(leg.begin_s + curve.breakpoints[piece + 1], leg.until_s)
            if end - begin > SHORTEST_PIECE_S:
                _append(times, terms, begin, end, coefficients)
        shifted = (replace(visit, time=leg.begin_s + visit.time) for visit in leg.flight.visits)
        visits += [visit for visit in shifted if visit.time <= leg.until_s]
    return Flight(Curve(np.array(times), _padded(terms)), tuple(visits)) if terms else None


def _append(times: list[float], terms: list[FloatArray], begin: float, end: float, coefficients: FloatArray) -> None:
    """Add a piece, after a rest where there is a gap before it."""
    if not times:
        times.append(begin)
    elif begin - times[-1] > SHORTEST_PIECE_S:
        terms.append(coefficients[:, :1])
        times.append(begin)
    terms.append(coefficients)
    times.append(end)


def _padded(terms: Sequence[FloatArray]) -> FloatArray:
    """(K, 3, D) of pieces with fewer terms and with more."""
    width = max(piece.shape[1] for piece in terms)
    return np.stack([np.pad(piece, ((0, 0), (0, width - piece.shape[1]))) for piece in terms])
