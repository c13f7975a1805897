"""What a flight leaves behind: the record of every step, and what was to be flown."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from flockopt.flights import Flight
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from sim.mission.measures import Measures, measure
from sim.physics.fleet import VELOCITY
from sim.physics.settings import FlightSettings
from sim.physics.world import Touch

__all__ = ["Execution"]


@dataclass(frozen=True)
class Execution:
    """A flight as it happened, recorded at every step of the physics.

    Attributes:
        scene: Where, with all drones that took off and all tasks that were wanted to the end or served before.
        flights: What was to be flown, by drone id; of several plans, as much of each as was flown.
        settings: How.
        times: (T,) s, from 0.
        states: (T, N, 17), columns as in `sim.physics.fleet`; NaN for a drone that is lost.
        touches: Every contact, when it began.
        energy: (N,) J that the rotors' shafts took.
        cpu_s: Processor seconds the flight took to compute.
    """

    scene: Scene
    flights: dict[str, Flight]
    settings: FlightSettings
    times: FloatArray
    states: FloatArray
    touches: tuple[Touch, ...]
    energy: FloatArray
    cpu_s: float

    @property
    def positions(self) -> FloatArray:
        """(T, N, 3) m."""
        return self.states[:, :, :3]

    @property
    def velocities(self) -> FloatArray:
        """(T, N, 3) m/s."""
        return self.states[:, :, VELOCITY]

    @property
    def attitudes(self) -> FloatArray:
        """(T, N, 4) unit quaternions (x, y, z, w)."""
        return self.states[:, :, 3:7]

    @property
    def real_time_factor(self) -> float:
        """Seconds flown for each processor second."""
        return float(self.times[-1]) / self.cpu_s

    @cached_property
    def measures(self) -> Measures:
        """What the flight achieved, measured on its record."""
        return measure(self.scene, self.flights, self.times, self.positions, self.settings.service_radius)
