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

from flockopt.batches.deadline import NEVER, Deadline, OutOfTime
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

__all__ = ["Clock", "DecodedFlights", "Flights", "GivenFlights", "Reporter", "draft", "finish", "out_of_time"]

#: Travel below this is none, and so is a bound: the gap of no travel to no bound is zero, while any other travel has none.
NO_TRAVEL_M = 1e-6

#: Share of what is left of a time limit that a try with a margin for tracking errors may take: there is one without.
MARGIN_SHARE = 0.5

#: Share of what is left of a time limit in which flights may be smoothed; how many a smoother is given at once.
SMOOTHING_SHARE, SMOOTHED_AT_ONCE = 0.5, 32

#: Called with a stage's name and the fraction of the whole that is done.
Reporter: TypeAlias = Callable[[str, float], None]


class Clock:
    """Seconds by stage, word of progress, and when all stages are to be over.

    Args:
        report: Told of each stage.
        deadline: No stage begins after it.
    """

    def __init__(self, report: Reporter | None = None, deadline: Deadline = NEVER) -> None:
        self._report = report
        self._began = perf_counter()
        self.deadline = deadline
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, fraction: float) -> Iterator[None]:
        """Time a stage that begins when ``fraction`` of the whole is done.

        Raises:
            OutOfTime: If the deadline has passed before it begins.
        """
        self.deadline.check(f"coming to the stage {name!r}")
        if self._report is not None:
            self._report(name, fraction)
        began = perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - began

    @contextmanager
    def within(self, share: float) -> Iterator[None]:
        """Give what follows only this share of the time that is left."""
        whole = self.deadline
        self.deadline = whole if share == 1.0 else whole.within(share)
        try:
            yield
        finally:
            self.deadline = whole

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
            flights = decode(scene, self.bundles, self.samples, travel=travel, deadline=clock.deadline)
        if self.smoothing or self.smoother is not None:
            with clock.stage("smooth", 0.65):
                until = clock.deadline.within(SMOOTHING_SHARE)
                better = self._proposed(scene, flights, until)
                better = smooth(scene, flights, starts=better, deadline=until) if self.smoothing else better
                flights = _within_range(scene, flights, better)
        return flights

    def _proposed(self, scene: Scene, flights: dict[str, Flight], until: Deadline) -> dict[str, Flight]:
        """What the smoother makes of the flights, some at a time; those that are not begun by the deadline stay as they are."""
        better, names = dict(flights), list(flights)
        for first in range(0, len(names) if self.smoother is not None else 0, SMOOTHED_AT_ONCE):
            if not until.is_over and self.smoother is not None:
                better |= self.smoother(scene, {name: flights[name] for name in names[first : first + SMOOTHED_AT_ONCE]})
        return better

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
        clock: Times the stages, and holds the deadline.

    Returns:
        A plan that is certified, uncertified with a certificate that says why, or infeasible as the bundles are. Where the
        deadline passes first: uncertified, without flights, and with that as its reason.
    """
    clock = clock or Clock()
    allocated = draft(scene, planner, bundles)
    if bundles.status == Status.INFEASIBLE:
        return replace(allocated, status=Status.INFEASIBLE)
    tries = margins(margin_m)
    for rank, (clearance_m, separation_m) in enumerate(tries, start=1):
        try:
            with clock.within(MARGIN_SHARE if rank < len(tries) else 1.0):
                room = scene, travel
                if clearance_m > 0.0 or separation_m > 0.0:
                    with clock.stage("room", 0.55):
                        room = roomier(scene, travel, bundles, clearance_m, separation_m, clock.deadline)
                flights: dict[str, Flight] | None = source.first(*room, clock)
                while flights is not None:
                    apart = _apart(room, bundles, flights, airborne, clock)
                    flown = replace(allocated, flights=apart.flights, cost=_cost(travel, bundles, apart.flights, proof))
                    with clock.stage("certify", 0.9):
                        certificate = certify(scene, flown, travel=travel, bound=proof, deadline=clock.deadline)
                    flights = None if certificate["separation"].holds else source.again(apart)
        except OutOfTime as fault:
            if rank < len(tries):
                continue
            unflown = _cost(travel, bundles, {}, proof)
            return replace(allocated, cost=unflown, reason=out_of_time(fault, clock))
        if is_enough(certificate):
            break
    status = Status.CERTIFIED if certificate.certified else Status.UNCERTIFIED
    return replace(flown, status=status, certificate=certificate)


def out_of_time(fault: OutOfTime, clock: Clock) -> str:
    """Why a plan was not finished, for its `flockopt.certificate.Plan.reason`."""
    return f"{fault}, after {clock.total:.2f} s; give it more time"


def _apart(
    room: tuple[Scene, Travel], bundles: Bundles, flights: dict[str, Flight], airborne: Collection[str], clock: Clock
) -> Deconflicted:
    with clock.stage("deconflict", 0.7):
        scene, travel = room
        return deconflict(scene, bundles, flights, travel=travel, airborne=airborne, deadline=clock.deadline)


def _within_range(scene: Scene, flights: dict[str, Flight], better: dict[str, Flight]) -> dict[str, Flight]:
    """The better flights, but for drones that would fly farther than they may."""
    longest = {drone.id: drone.max_distance for drone in scene.drones if drone.max_distance is not None}
    too_long = {name for name, most in longest.items() if name in better and better[name].curve.length > most}
    return better | {name: flights[name] for name in too_long}


def draft(scene: Scene, planner: str, bundles: Bundles) -> Plan:
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
