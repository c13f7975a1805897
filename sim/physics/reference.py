"""Where drones should be: the flights of a plan packed for compiled code, with derivatives up to the snap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.certificate.plan_file import LARGEST_DEGREE
from flockopt.flights import Flight
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone
from sim.physics.vectors import Vector

__all__ = ["Reference", "pack_flights", "state_at"]

NUM_TERMS = LARGEST_DEGREE + 1


class Reference(NamedTuple):
    """The flights of N drones, K pieces in all; a parked drone has one piece that stands still.

    Attributes:
        first: (N + 1,) the first piece of each drone, and K.
        begins: (K,) s, when each piece begins.
        ends: (K,) s.
        coefficients: (K, 3, 8) of the powers of (t - begin).
        piece: (N,) the piece each drone is in, moved on as time passes.
    """

    first: NDArray[np.int64]
    begins: FloatArray
    ends: FloatArray
    coefficients: FloatArray
    piece: NDArray[np.int64]


def pack_flights(drones: Sequence[Drone], flights: Mapping[str, Flight]) -> Reference:
    """Pack the flights of drones, by id; those without one stay at their start."""
    first, begins, ends, coefficients = [0], [], [], []
    for drone in drones:
        flight = flights.get(drone.id)
        if flight is None:
            times, terms = np.array([0.0, 1.0]), np.array(drone.start).reshape(1, 3, 1)
        else:
            times, terms = flight.curve.breakpoints, flight.curve.coefficients
        padded = np.zeros((len(terms), 3, NUM_TERMS))
        padded[:, :, : terms.shape[2]] = terms[:, :, :NUM_TERMS]
        begins.append(times[:-1])
        ends.append(times[1:])
        coefficients.append(padded)
        first.append(first[-1] + len(terms))
    offsets = np.array(first, dtype=np.int64)
    return Reference(
        offsets, np.concatenate(begins), np.concatenate(ends), np.concatenate(coefficients), offsets[:-1].copy()
    )  # fmt: skip


@compiled_lazily(error_model="numpy")
def state_at(reference: Reference, drone: int, time: float) -> tuple[Vector, Vector, Vector, Vector, Vector]:
    """Position, velocity, acceleration, jerk and snap of a drone's plan; times are asked for in rising order."""
    piece, last = reference.piece[drone], reference.first[drone + 1] - 1
    while piece < last and time >= reference.ends[piece]:
        piece += 1
    reference.piece[drone] = piece
    begin, end = reference.begins[piece], reference.ends[piece]
    local = min(max(time, begin), end) - begin
    x = _derivatives(reference.coefficients, piece, 0, local)
    y = _derivatives(reference.coefficients, piece, 1, local)
    z = _derivatives(reference.coefficients, piece, 2, local)
    position, still = (x[0], y[0], z[0]), (0.0, 0.0, 0.0)
    if time < begin or time > end:
        return position, still, still, still, still
    return position, (x[1], y[1], z[1]), (x[2], y[2], z[2]), (x[3], y[3], z[3]), (x[4], y[4], z[4])


@compiled_lazily(error_model="numpy")
def _derivatives(coefficients: FloatArray, piece: int, axis: int, t: float) -> tuple[float, float, float, float, float]:
    """The value and four derivatives of a polynomial: Horner's scheme gives the k-th over k factorial."""
    value = first = second = third = fourth = 0.0
    for n in range(NUM_TERMS - 1, -1, -1):
        fourth = fourth * t + third
        third = third * t + second
        second = second * t + first
        first = first * t + value
        value = value * t + coefficients[piece, axis, n]
    return value, first, 2.0 * second, 6.0 * third, 24.0 * fourth
