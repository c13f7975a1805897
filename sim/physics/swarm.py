"""Drones in a PyBullet world: their physical states, moved on a step at a time, and drones taken out of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from sim.physics.fleet import CONTROLLERS, ROTORS, STATE_WIDTH, VELOCITY, add_downwash, advance
from sim.physics.mellinger import MELLINGER, tunings
from sim.physics.reference import Reference
from sim.physics.settings import FlightSettings
from sim.physics.vehicles import airframes, hover_speeds, vehicle_names, vehicles_of
from sim.physics.world import Touch, World

__all__ = ["Swarm"]


class Swarm:
    """The drones that are in the air or could be; to be closed after use.

    Args:
        scene: Where they are, from their starts on.
        settings: How they are flown.
        gui: Whether to open PyBullet's window.

    Attributes:
        ids: Of the drones that are left, in the order of the rows below.
        columns: Their places in the scene's fleet.
        state: (N, 17), columns as in `sim.physics.fleet`.

    Raises:
        SettingsError: If the controller does not fly the vehicle.
        MissingExtra: If PyBullet is not installed.
    """

    def __init__(self, scene: Scene, settings: FlightSettings, *, gui: bool = False) -> None:
        vehicles = vehicles_of(scene, settings.vehicle)
        self.ids = [drone.id for drone in scene.drones]
        self.columns = np.arange(scene.num_drones, dtype=np.int64)
        self._settings, self._energy = settings, np.zeros(scene.num_drones)
        self._frames = airframes(vehicles)
        self._firmware = np.zeros(scene.num_drones, dtype=MELLINGER)
        if settings.controller == "mellinger":
            self._firmware = tunings(scene, vehicle_names(scene, settings.vehicle), self._frames)
        self.state = np.zeros((scene.num_drones, STATE_WIDTH))
        self.state[:, :3], self.state[:, 6], self.state[:, ROTORS] = scene.starts, 1.0, hover_speeds(vehicles)
        self.state[:, VELOCITY] = [drone.velocity for drone in scene.drones]
        self._integrals, self._wind, self._drive, self._spin = (np.zeros((scene.num_drones, 3)) for _ in range(4))
        self._work = np.zeros(scene.num_drones)
        self._step_s = 1.0 / settings.physics_hz
        self._world = World(scene, vehicles, self._step_s, shape=settings.shape, gui=gui, every_step=settings.every_step)

    def step(self, reference: Reference, clock_s: float, air: FloatArray | None, time_s: float) -> list[Touch]:
        """Move all drones on by one step of the physics.

        Args:
            reference: What they follow, rows as `ids`.
            clock_s: When the step begins, on the reference's clock.
            air: (3,) m/s, the wind, which controllers do not know of; None where there has never been any.
            time_s: When the step ends, for the touches.

        Returns:
            What touches now and did not before.
        """
        settings = self._settings
        if air is not None or settings.has_downwash:
            self._wind[:] = 0.0 if air is None else air
            if settings.has_downwash:
                add_downwash(self._frames, self.state, self._wind)
        advance(
            reference, self._frames, self._frames, self._firmware, self.state, self._integrals, self._wind, self._drive,
            self._spin, self._work, CONTROLLERS[settings.controller], settings.has_drag, clock_s, self._step_s,
            settings.num_inner,
        )  # fmt: skip
        return self._world.step(self.state, self._drive, self._spin, time_s)

    @property
    def energy(self) -> FloatArray:
        """(N0,) J that the rotors' shafts took, of every drone of the scene, lost ones too."""
        energy = self._energy.copy()
        energy[self.columns] = self._work
        return energy

    def lose(self, lost: Sequence[str]) -> None:
        """Take drones out of the world, where they are: what becomes of them is not simulated."""
        rows = [self.ids.index(drone) for drone in lost]
        self._energy = self.energy
        for row in sorted(rows, reverse=True):
            self._world.remove(row)
            del self.ids[row]
        self.columns = np.delete(self.columns, rows)
        for name in ("_frames", "_firmware", "state", "_integrals", "_wind", "_drive", "_spin", "_work"):
            setattr(self, name, np.delete(getattr(self, name), rows, axis=0))

    def close(self) -> None:
        """Shut the world down."""
        self._world.close()
