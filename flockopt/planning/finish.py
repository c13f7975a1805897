"""The finishing line: every proposal, whoever made it, is flown, kept apart, costed and judged in the same way.

decode → smooth → apart → cost → certify, with more room than the scene asks for where the settings want it: the widest margin
first, until no smaller one would mend what the certificate still finds (`flockopt.planning.margins.is_enough`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Protocol, TypeAlias

from flockopt.bundles import Bound, Bundles
from flockopt.certificate import Cost, Plan
from flockopt.certificate.judge import certify
from flockopt.flights import Flight
from flockopt.flights.apart.deconflict import Deconflicted, deconflict
from flockopt.flights.decode import decode
from flockopt.flights.smoothing.smooth import smooth
from flockopt.planning.margins import is_enough, margins, roomier
from flockopt.planning.planners import Smoother
from flockopt.records.arrays import FloatArray
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["Clock", "DecodedFlights", "Flights", "GivenFlights", "Reporter", "finish"]

#: Travel below this is none, and so is a bound: the gap of no travel to no bound is zero, while any other travel has none.
NO_TRAVEL_M = 1e-6

#: Called with a stage's name and the fraction of the whole that is done.
Reporter: TypeAlias = Callable[[str, float], None]


class Clock:
    """Seconds by stage, and word of progress."""

    def __init__(self, report: Reporter | None = None) -> None:
        self._report = report
        self._began = perf_counter()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, fraction: float) -> Iterator[None]:
        """Time a stage that begins when ``fraction`` of the whole is done."""
        if self._report is not None:
            self._report(name, fraction)
        began = perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - began

    @property
    def total(self) -> float:
        """Seconds since the beginning."""
        return perf_counter() - self._began

    def timing(self) -> dict[str, float]:
        """The stages' seconds and their total."""
        return {**self.seconds, "total": self.total}


class Flights(Protocol):
    """Where the flights of a proposal come from."""

    def first(self, scene: Scene, travel: Travel, clock: Clock) -> dict[str, Flight]:
        """Flights by drone id in a scene, which may ask for more room than the one that is planned."""

    def again(self, apart: Deconflicted) -> dict[str, Flight] | None:
        """Other flights in the same scene, since these meet; None where there are none to try."""


@dataclass(frozen=True)
class DecodedFlights:
    """Flights decoded from bundles, and smoothed if somebody is to.

    Attributes:
        bundles: Which drone visits what.
        samples: (N, T, 3) m, control points, or None to follow the shortest paths.
        smoother: Makes better flights of them, or None.
        smoothing: Whether the solver smooths too; it begins with what ``smoother`` makes.
    """

    bundles: Bundles
    samples: FloatArray | None = None
    smoother: Smoother | None = None
    smoothing: bool = False

    def first(self, scene: Scene, travel: Travel, clock: Clock) -> dict[str, Flight]:
        """See `Flights.first`."""
        with clock.stage("decode", 0.6):
            flights = decode(scene, self.bundles, self.samples, travel=travel)
        if self.smoothing or self.smoother is not None:
            with clock.stage("smooth", 0.65):
                better = flights if self.smoother is None else self.smoother(scene, flights)
                better = smooth(scene, flights, starts=better) if self.smoothing else better
                flights = _within_range(scene, flights, better)
        return flights

    def again(self, apart: Deconflicted) -> None:
        """There are no others."""


@dataclass(frozen=True)
class GivenFlights:
    """Flights that are there already, by drone id."""

    flights: Mapping[str, Flight] = field(default_factory=dict)

    def first(self, scene: Scene, travel: Travel, clock: Clock) -> dict[str, Flight]:
        """See `Flights.first`."""
        return dict(self.flights)

    def again(self, apart: Deconflicted) -> None:
        """There are no others."""


def finish(
    scene: Scene,
    travel: Travel,
    bundles: Bundles,
    source: Flights,
    *,
    planner: str,
    proof: Bound | None = None,
    margin_m: float = 0.0,
    airborne: Collection[str] = (),
    clock: Clock | None = None,
) -> Plan:
    """The plan that comes of bundles, judged.

    Args:
        scene: The scene.
        travel: Its travel.
        bundles: Which drone visits what, and what is left out.
        source: Where flights come from.
        planner: Who proposed.
        proof: A lower bound on travel with its proof, or None to claim none.
        margin_m: Room to keep for tracking errors where there is some, metres.
        airborne: Ids of drones that may make way although they have no capacity: it is used up, and they hover.
        clock: Times the stages.

    Returns:
        A plan that is certified, uncertified with a certificate that says why, or infeasible as the bundles are.
    """
    clock = clock or Clock()
    draft = _draft(scene, planner, bundles)
    if bundles.status == Status.INFEASIBLE:
        return replace(draft, status=Status.INFEASIBLE)
    for clearance_m, separation_m in margins(margin_m):
        roomier_scene, roomier_travel = scene, travel
        if clearance_m > 0.0 or separation_m > 0.0:
            with clock.stage("room", 0.55):
                roomier_scene, roomier_travel = roomier(scene, travel, bundles, clearance_m, separation_m)
        flights: dict[str, Flight] | None = source.first(roomier_scene, roomier_travel, clock)
        while flights is not None:
            with clock.stage("deconflict", 0.7):
                apart = deconflict(roomier_scene, bundles, flights, travel=roomier_travel, airborne=airborne)
            draft = replace(draft, flights=apart.flights, cost=_cost(travel, bundles, apart.flights, proof))
            with clock.stage("certify", 0.9):
                certificate = certify(scene, draft, travel=travel, bound=proof)
            flights = None if certificate["separation"].holds else source.again(apart)
        if is_enough(certificate):
            break
    status = Status.CERTIFIED if certificate.certified else Status.UNCERTIFIED
    return replace(draft, status=status, certificate=certificate)


def _within_range(scene: Scene, flights: dict[str, Flight], better: dict[str, Flight]) -> dict[str, Flight]:
    """The better flights, but for drones that would fly farther than they may."""
    longest = {drone.id: drone.max_distance for drone in scene.drones if drone.max_distance is not None}
    too_long = {name for name, most in longest.items() if name in better and better[name].curve.length > most}
    return better | {name: flights[name] for name in too_long}


def _draft(scene: Scene, planner: str, bundles: Bundles) -> Plan:
    """The plan as far as the allocation makes it."""
    names = [task.id for task in scene.tasks]
    return Plan(
        scene_name=scene.name,
        scene_sha256=scene.sha256,
        planner=planner,
        status=Status.UNCERTIFIED,
        routes={drone.id: tuple(names[task] for task in route) for drone, route in zip(scene.drones, bundles, strict=True)},
        unserved={names[task]: reason for task, reason in bundles.unserved},
        reason=bundles.reason,
        flights={},
        cost=Cost(length=0.0, travel=0.0, lower_bound=None, gap=None, makespan=0.0),
    )


def _cost(travel: Travel, bundles: Bundles, flights: dict[str, Flight], proof: Bound | None) -> Cost:
    """What flights along bundles cost, against a proven bound where there is one."""
    total = travel.total(bundles.routes)
    lower, gap = None, None
    if proof is not None:
        lower = proof.value
        gap = max(total - lower, 0.0) / lower if lower > NO_TRAVEL_M else 0.0 if total <= NO_TRAVEL_M else None
    return Cost(
        length=sum(flight.curve.length for flight in flights.values()),
        travel=total,
        lower_bound=lower,
        gap=gap,
        makespan=max((flight.curve.end_time for flight in flights.values()), default=0.0),
    )
