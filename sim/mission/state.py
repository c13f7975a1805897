"""How a mission stands: what is flown, what is to be flown next, what is due, and what has happened so far.

The record holds data and what can be read off it. Functions move it on: time in `sim.mission.flying`, orders in
`sim.mission.orders`. They bring it up to date in place, since a world and the record of every step are not copied at each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

from flockopt.certificate import Plan
from flockopt.planning.replan import Replanned
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from sim.mission.ledger import Ledger
from sim.mission.recording import Recording
from sim.mission.stitching import Leg
from sim.mission.wind import Wind
from sim.physics.reference import Reference, pack_flights
from sim.physics.settings import FlightSettings
from sim.physics.swarm import Swarm
from sim.physics.world import Touch

__all__ = ["MissionState", "MissionTerms", "launch"]


@dataclass(frozen=True)
class MissionTerms:
    """What a mission is flown on, from beginning to end.

    Attributes:
        scene: Where the fleet takes off.
        settings: How it flies.
        seed: Of the searches that replanning takes.
        tracking_margin_m: Room that new plans keep for tracking errors, metres.
        freeze_s: How long the old plan is flown on after a change, seconds.
        is_shown: Whether PyBullet's window is open, and nothing is flown faster than real time.
    """

    scene: Scene
    settings: FlightSettings
    seed: int
    tracking_margin_m: float
    freeze_s: float
    is_shown: bool

    @cached_property
    def columns(self) -> dict[str, int]:
        """Places of all drones in the recording, by id."""
        return {drone.id: column for column, drone in enumerate(self.scene.drones)}

    @property
    def step_s(self) -> float:
        """Seconds a step of the physics."""
        return 1.0 / self.settings.physics_hz


@dataclass
class MissionState:
    """How a mission stands; seconds are those of the mission.

    Attributes:
        terms: What it is flown on.
        swarm: The drones that are left, in their world.
        recording: All drones at every step so far.
        ledger: Tasks wanted and served, drones lost and late.
        scene: What the plan now flown was made for: drones from its beginning on, tasks that were open then.
        plan: The plan now flown.
        reference: The same, packed for the drones that are left.
        legs: What each drone flies of each plan, by id.
        begun_s: When the plan was swapped in.
        pending: The certified answer that is to be swapped in next, or None.
        wind: What blows.
        answers: The answer to every replanning.
        swapped: Those of them that have been swapped in.
        touches: Contacts so far.
        cpu_s: Processor seconds that flying has taken.
    """

    terms: MissionTerms
    swarm: Swarm
    recording: Recording
    ledger: Ledger
    scene: Scene
    plan: Plan
    reference: Reference
    legs: dict[str, list[Leg]]
    begun_s: float = 0.0
    pending: Replanned | None = None
    wind: list[Wind] = field(default_factory=list)
    answers: list[Replanned] = field(default_factory=list)
    swapped: list[Replanned] = field(default_factory=list)
    touches: list[Touch] = field(default_factory=list)
    cpu_s: float = 0.0

    @property
    def now_s(self) -> float:
        """Seconds since the beginning."""
        return self.recording.now_s

    @property
    def swap_s(self) -> float:
        """When the pending plan is swapped in; infinite without one."""
        return math.inf if self.pending is None else self.begun_s + self.pending.swap_s

    @property
    def end_s(self) -> float:
        """When the last flight of the plan now flown comes to its end."""
        return self.begun_s + max((flight.curve.end_time for flight in self.plan.flights.values()), default=0.0)

    @property
    def positions(self) -> dict[str, FloatArray]:
        """(3,) m by id of every drone that is not lost."""
        return dict(zip(self.swarm.ids, self.swarm.state[:, :3].copy(), strict=True))

    @property
    def served(self) -> tuple[str, ...]:
        """Ids of the tasks served so far."""
        return tuple(self.ledger.served)

    @property
    def open(self) -> tuple[str, ...]:
        """Ids of the tasks that are wanted and not served yet."""
        return self.ledger.open

    @property
    def unserved(self) -> dict[str, str]:
        """Reasons by id of the open tasks that nobody is on the way to, as far as they are known."""
        return self.ledger.unserved(self.terms.settings.service_radius)


def launch(terms: MissionTerms, plan: Plan) -> MissionState:
    """The fleet at its starts, about to fly a plan.

    Raises:
        SettingsError: If the controller does not fly the vehicle.
        MissingExtra: If PyBullet is not installed.
    """
    scene = terms.scene
    swarm = Swarm(scene, terms.settings, gui=terms.is_shown)
    return MissionState(
        terms=terms, swarm=swarm, recording=Recording(swarm.state, terms.step_s), ledger=Ledger(scene, plan), scene=scene,
        plan=plan, reference=pack_flights(scene.drones, plan.flights),
        legs={drone.id: [Leg(plan.flights.get(drone.id))] for drone in scene.drones},
    )  # fmt: skip
