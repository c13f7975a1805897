"""From bundles to smooth flights that keep clear of obstacles and of each other."""

from flockopt.flights.curve import Curve, Flight, Visit

__all__ = ["Curve", "Flight", "Visit"]
