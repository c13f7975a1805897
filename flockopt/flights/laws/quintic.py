"""The paper's decoder: control points, a spline through them, and a law of progress that stops at every anchor.

A drone's start, tasks and end are exact anchors; the waypoints between them are control points of one centripetal
Catmull-Rom curve. Each leg from anchor to anchor is flown by the minimum-jerk law ``rho = 10 tau**3 - 15 tau**4 +
6 tau**5``, so the drone **stops at each anchor**, as in the paper (FlockDiffusion, "Constraint Preserving Trajectory
Decoding"). Nothing is searched, and all drones are decoded at once.

Cubic spans under a quintic law are of degree 15, and C1 only at inner control points. What is flown is their fit by
pieces of degree 7 (`flockopt.flights.laws.refit`), and what is checked is what is flown: where it cuts into an
inflated obstacle, the leg is corrected locally, in the end down to its polyline with a stop at every corner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flockopt.flights import Curve, Flight
from flockopt.flights.laws.catmull_rom import CatmullRom
from flockopt.flights.laws.correction import corrected, densified
from flockopt.flights.laws.fit_error import largest_error
from flockopt.flights.laws.leg_pieces import assembled, faulty_legs, leg_seconds
from flockopt.flights.laws.refit import FIT_TERMS, fit_operator, fit_phases
from flockopt.flights.room import MOST_PIECES, Room
from flockopt.flights.waypoints import Waypoints
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

__all__ = ["QuinticDecoding", "decode_quintic", "progress"]

#: Pieces a span of the spline is fitted by where the memory holds them: the fit then errs by millimetres.
PIECES_A_SPAN = 2

#: More pieces than this add nothing to a leg's fit.
MOST_LEG_PIECES = 16

#: How often the control points of a leg that cuts in are doubled before it is flown with stops.
DOUBLINGS = 3


def progress(phase: FloatArray) -> FloatArray:
    """The share of a leg that is behind the drone at a phase of its time, both 0 to 1: rho(tau) in the paper."""
    return phase**3 * (10.0 - phase * (15.0 - 6.0 * phase))


@dataclass
class _Leg:
    """A leg on its way through correction."""

    waypoints: FloatArray  # (V, 3) m, the clear polyline
    control: FloatArray  # (K + 1, 3) m
    alone: bool = False  # whether the curve bends for the leg's own points only
    doublings: int = 0

    @property
    def is_straight(self) -> bool:
        return self.alone and len(self.control) == 2

    def mended(self, room: Room, radius: float) -> list[_Leg]:
        """What to fly in place of a leg that cuts in; the leg itself when nothing is left to try."""
        if not self.alone:
            return [_Leg(self.waypoints, self.control, True)]
        if len(self.waypoints) == 2:
            return [_Leg(self.waypoints, self.waypoints, True)]
        if self.doublings < DOUBLINGS:
            closer = corrected(densified(self.control), room, radius)
            return [_Leg(self.waypoints, closer, True, self.doublings + 1)]
        return self.with_stops()

    def with_stops(self) -> list[_Leg]:
        """The leg's polyline, a stop at every corner."""
        pairs = (self.waypoints[k : k + 2] for k in range(len(self.waypoints) - 1))
        return [_Leg(pair, pair, True) for pair in pairs]


@dataclass
class _Route:
    """One drone's legs and what flies them."""

    waypoints: Waypoints
    room: Room
    radius: float
    legs: list[_Leg]
    ends: list[int]  # for each leg the waypoint it ends at, or -1
    pieces: FloatArray = field(init=False)  # (P, 3, 8) of all legs, in fractions of a piece
    counts: NDArray[np.int64] = field(init=False)  # (L,) pieces of each leg
    seconds: FloatArray = field(init=False)  # (L,)
    faulty: NDArray[np.bool_] = field(init=False)  # (L,)

    @classmethod
    def begin(cls, waypoints: Waypoints, room: Room, radius: float) -> _Route:
        last = len(waypoints.points) - 1
        anchors = [k for k in range(last + 1) if k in (0, last) or waypoints.tasks[k] or waypoints.rest_s[k] >= 0.0]
        ways = [waypoints.points[a : b + 1] for a, b in pairwise(anchors)]
        legs = [_Leg(way, corrected(way, room, radius) if len(way) > 2 else way) for way in ways]
        return cls(waypoints, room, radius, legs, anchors[1:])

    def num_pieces(self) -> list[int]:
        """Pieces for each leg: as many as its bends ask for and the memory leaves."""
        wanted = [1 if leg.is_straight else min(PIECES_A_SPAN * (len(leg.control) - 1), MOST_LEG_PIECES) for leg in self.legs]
        rests = int((self.waypoints.rest_s[self.ends] > 0.0).sum())
        excess = sum(wanted) + rests - MOST_PIECES
        while excess > 0 and max(wanted) > 1:
            wanted[wanted.index(max(wanted))] -= 1
            excess -= 1
        return wanted

    def mend(self) -> bool:
        """Correct the legs that cut in; whether that changed any."""
        legs, ends, changed = [], [], False
        for leg, end, faulty in zip(self.legs, self.ends, self.faulty, strict=True):
            parts = leg.mended(self.room, self.radius) if faulty and not leg.is_straight else [leg]
            changed |= faulty and not leg.is_straight
            legs += parts
            ends += [-1] * (len(parts) - 1) + [end]
        self.legs, self.ends = legs, ends
        return changed

    def stop_everywhere(self) -> None:
        """Fly the waypoints' polyline, the shortest way there is."""
        parts = [leg.with_stops() for leg in self.legs]
        self.ends = [end for end, split in zip(self.ends, parts, strict=True) for end in [-1] * (len(split) - 1) + [end]]
        self.legs = [leg for split in parts for leg in split]

    def flight(self, scene: Scene) -> Flight:
        """The flight: legs one after another, with a rest where the waypoints ask for one."""
        way, ends = self.waypoints, np.array(self.ends)
        breakpoints, coefficients, times = assembled(self.pieces, self.counts, self.seconds, ends, way.points, way.rest_s)
        return Flight(Curve(breakpoints, coefficients), way.visits(scene, times))


@dataclass(frozen=True, eq=False)
class QuinticDecoding:
    """What the decoder makes of a fleet's waypoints.

    Attributes:
        flights: By drone id.
    """

    flights: dict[str, Flight]
    _routes: dict[str, _Route]

    @cached_property
    def fit_error_m(self) -> dict[str, float]:
        """For each drone how far its flight is from the spline under the quintic law at most, metres: a proven bound."""
        result = {}
        for name, route in self._routes.items():
            curve, per_leg = _spline([route]), np.split(route.pieces, np.cumsum(route.counts)[:-1])
            result[name] = max(largest_error(curve, leg, pieces, progress) for leg, pieces in enumerate(per_leg))
        return result


def decode_quintic(scene: Scene, ways: Mapping[int, Waypoints]) -> QuinticDecoding:
    """Flights through waypoints by the paper's decoder.

    Args:
        scene: The scene.
        ways: Waypoints that move, by drone index; their polylines are clear of obstacles.
    """
    rooms = Room.of_fleet(scene, ways)
    routes = {index: _Route.begin(way, rooms[index], scene.drones[index].radius) for index, way in ways.items()}
    pending = list(routes.values())
    while pending:
        _shape(pending)
        pending = [route for route in pending if route.mend()]
    flights = {scene.drones[index].id: route.flight(scene) for index, route in routes.items()}
    for index, route in routes.items():
        drone = scene.drones[index]
        if drone.max_distance is not None and flights[drone.id].curve.length > drone.max_distance:
            route.stop_everywhere()
            _shape([route])
            flights[drone.id] = route.flight(scene)
    return QuinticDecoding(flights, {scene.drones[index].id: route for index, route in routes.items()})


def _spline(routes: Sequence[_Route]) -> CatmullRom:
    """The spline through the control points of all legs of some drones; a drone's legs are one curve."""
    points = [leg.control for route in routes for leg in route.legs]
    first = np.concatenate([[0], np.cumsum([len(control) for control in points])])
    joined = []
    for route in routes:
        alone = [True] + [leg.alone for leg in route.legs]
        joined += [not (before or here) for before, here in pairwise(alone)]
    return CatmullRom(np.concatenate(points), first, np.array(joined))


def _shape(routes: Sequence[_Route]) -> None:
    """Fit pieces to the spline through the routes' control points, time them, and find the legs that cut in."""
    curve = _spline(routes)
    counts = np.array([count for route in routes for count in route.num_pieces()])
    first = np.concatenate([[0], np.cumsum(counts)])
    pieces = np.empty((first[-1], 3, FIT_TERMS))
    for count in np.unique(counts).tolist():
        legs = np.flatnonzero(counts == count)
        share = np.broadcast_to(progress(fit_phases(count)), (len(legs), len(fit_phases(count))))
        samples = curve(legs[:, None], share)  # (L, S, 3)
        fitted = np.tensordot(samples, fit_operator(count), axes=(1, 1))  # (L, 3, P * 8)
        places = first[legs][:, None] + np.arange(count)
        pieces[places] = fitted.reshape(len(legs), 3, count, FIT_TERMS).transpose(0, 2, 1, 3)
    per_leg = [len(route.legs) for route in routes]
    limits = np.repeat([route.room.limits for route in routes], per_leg, axis=0)
    seconds = leg_seconds(pieces, first, limits)
    leg = 0
    for route in routes:
        end = leg + len(route.legs)
        route.pieces, route.counts = pieces[first[leg] : first[end]], counts[leg:end]
        route.seconds = seconds[leg:end]
        route.faulty = faulty_legs(pieces, first[leg : end + 1], route.room.space)
        leg = end
