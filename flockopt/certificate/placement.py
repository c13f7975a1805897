"""Plans and certificates in another frame: the same flights, clauses and margins, seen from elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flockopt.certificate.certificate import Certificate
from flockopt.certificate.plan_file import Plan
from flockopt.flights import Curve, Flight
from flockopt.records.arrays import FloatArray
from flockopt.scene.frame import Frame

__all__ = ["certificate_from", "flights_from", "flights_into", "plan_into"]


def flights_into(frame: Frame, flights: dict[str, Flight]) -> dict[str, Flight]:
    """Flights of the scene in a frame; themselves where the frame is the scene's own."""
    return flights if frame.is_own else _moved(flights, -frame.vector)


def flights_from(frame: Frame, flights: dict[str, Flight]) -> dict[str, Flight]:
    """Flights of a frame in the scene's own coordinates."""
    return flights if frame.is_own else _moved(flights, frame.vector)


def plan_into(frame: Frame, plan: Plan) -> Plan:
    """A plan whose flights are in a frame."""
    return plan if frame.is_own else replace(plan, flights=flights_into(frame, plan.flights))


def certificate_from(frame: Frame, certificate: Certificate) -> Certificate:
    """A certificate whose places are in the scene's own coordinates."""
    if frame.is_own:
        return certificate
    clauses = tuple(
        clause if clause.place is None else replace(clause, place=frame.out_of(clause.place)) for clause in certificate.clauses
    )
    return replace(certificate, clauses=clauses)


def _moved(flights: dict[str, Flight], by: FloatArray) -> dict[str, Flight]:
    """Flights begun elsewhere: only the terms of power zero hold where that is."""
    moved = {}
    for name, flight in flights.items():
        coefficients = np.array(flight.curve.coefficients)
        coefficients[:, :, 0] += by
        moved[name] = replace(flight, curve=Curve(flight.curve.breakpoints, coefficients))
    return moved
