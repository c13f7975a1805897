"""What a flight can be told, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flockopt.errors import SettingsError
from flockopt.records import checks
from sim.physics.fleet import CONTROLLERS
from sim.physics.vehicles import VEHICLES
from sim.physics.world import SHAPES

__all__ = ["FlightSettings"]


@dataclass(frozen=True)
class FlightSettings:
    """How a plan is flown.

    Attributes:
        vehicle: One of `sim.physics.vehicles.VEHICLES` for all drones, or None to choose by each drone's mass or radius.
        controller: One of `sim.physics.fleet.CONTROLLERS`.
        physics_hz: PyBullet's steps a second.
        attitude_hz: Least rate of the controllers and rotors; they run a whole number of times in each step of the physics.
        service_radius: How near a drone must be for its task to count, metres.
        settle_s: How long the flight is watched after the plan's end, seconds.
        has_drag: Whether air resists.
        has_downwash: Whether drones feel the air that those above them blow down (only with drag).
        shape: The drones' collision shape, one of `sim.physics.world.SHAPES`.
        every_step: Whether PyBullet moves all bodies in every step, not only while something is near; the flight is the same.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    vehicle: str | None = None
    controller: str = "geometric"
    physics_hz: float = 240.0
    attitude_hz: float = 500.0
    service_radius: float = 0.10
    settle_s: float = 0.5
    has_drag: bool = True
    has_downwash: bool = False
    shape: str = "ball"
    every_step: bool = False

    def __post_init__(self) -> None:
        checks.store(self, checks.number, SettingsError, "physics_hz", "attitude_hz", "service_radius", above=0.0)
        checks.store(self, checks.number, SettingsError, "settle_s", least=0.0)
        checks.store(self, checks.choice, SettingsError, "controller", known=CONTROLLERS)
        checks.store(self, checks.choice, SettingsError, "shape", known=SHAPES)
        if self.vehicle is not None:
            checks.store(self, checks.choice, SettingsError, "vehicle", known=VEHICLES)
        checks.store(self, checks.flag, SettingsError, "has_drag", "has_downwash", "every_step")
        if self.has_downwash and not self.has_drag:
            raise SettingsError("has_downwash", "is True", "needs has_drag, through which air is felt", "set both or neither")

    @property
    def num_inner(self) -> int:
        """How often controllers run in a step of the physics."""
        return max(1, math.ceil(self.attitude_hz / self.physics_hz - 1e-9))
