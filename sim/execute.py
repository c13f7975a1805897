"""Fly a plan in PyBullet and record what happens."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flockopt.certify import certify
from flockopt.curve import Flight
from flockopt.errors import PlanError
from flockopt.geometry import FloatArray
from flockopt.judging import check_names
from flockopt.planfile import Plan
from flockopt.scene import Scene
from flockopt.travel import Travel
from sim.fleet import CONTROLLERS, ROTORS, STATE_WIDTH, VELOCITY, add_downwash, advance
from sim.measures import Outcome, measure
from sim.mellinger import MELLINGER, tunings
from sim.reference import pack_flights
from sim.settings import FlightSettings
from sim.vehicles import airframes, hover_speeds, vehicle_names, vehicles_of
from sim.world import Touch, World

__all__ = ["Execution", "execute"]


@dataclass(frozen=True)
class Execution:
    """A flight as it happened, recorded at every step of the physics.

    Attributes:
        scene: Where.
        flights: What was to be flown, by drone id.
        settings: How.
        times: (T,) s, from 0.
        states: (T, N, 17), columns as in `sim.fleet`.
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
    def outcome(self) -> Outcome:
        """What the flight achieved, measured on its record."""
        return measure(self.scene, self.flights, self.times, self.positions, self.settings.service_radius)


def execute(
    scene: Scene,
    plan: Plan,
    settings: FlightSettings | None = None,
    *,
    force: bool = False,
    travel: Travel | None = None,
    gui: bool = False,
) -> Execution:
    """Fly a plan.

    Args:
        scene: The scene.
        plan: A plan for it. What it says of itself is not believed: it is certified anew.
        settings: How to fly; the defaults otherwise.
        force: Fly it even if a clause of its certificate fails.
        travel: The scene's travel, if it is at hand; the judge computes it otherwise.
        gui: Whether to open PyBullet's window and fly no faster than real time.

    Raises:
        PlanError: If the plan is for another scene, or does not hold and ``force`` is not set.
        SettingsError: If the controller does not fly the vehicle.
        MissingExtra: If PyBullet is not installed.
    """
    settings = settings or FlightSettings()
    check_names(scene, plan)
    if not force:
        _require_certified(scene, plan, travel)
    return _Run(scene, plan, settings).fly(gui=gui)


def _require_certified(scene: Scene, plan: Plan, travel: Travel | None) -> None:
    mend = "plan the scene again, or fly it all the same with force=True (--force)"
    if plan.status == "infeasible":
        raise PlanError("status", f"is 'infeasible' ({plan.reason})", "only certified plans are flown", mend)
    failed = [clause for clause in certify(scene, plan, travel=travel).clauses if not clause.holds]
    if failed:
        words = f"fails ({', '.join(clause.name for clause in failed)}: {failed[0].detail})"
        raise PlanError("certificate", words, "only certified plans are flown", mend)


class _Run:
    """Everything that changes while a plan is flown."""

    def __init__(self, scene: Scene, plan: Plan, settings: FlightSettings) -> None:
        self.scene, self.flights, self.settings = scene, plan.flights, settings
        self.vehicles = vehicles_of(scene, settings.vehicle)
        self.frames = airframes(self.vehicles)
        self.firmware = np.zeros(scene.num_drones, dtype=MELLINGER)
        if settings.controller == "mellinger":
            self.firmware = tunings(scene, vehicle_names(scene, settings.vehicle), self.frames)
        self.reference = pack_flights(scene, plan.flights)
        self.state = np.zeros((scene.num_drones, STATE_WIDTH))
        self.state[:, :3], self.state[:, 6], self.state[:, ROTORS] = scene.starts, 1.0, hover_speeds(self.vehicles)
        self.state[:, VELOCITY] = [drone.velocity for drone in scene.drones]
        self.integrals, self.wind, self.drive, self.spin = (np.zeros((scene.num_drones, 3)) for _ in range(4))
        self.energy = np.zeros(scene.num_drones)
        makespan = max((flight.curve.end_time for flight in plan.flights.values()), default=0.0)
        self.num_steps = max(1, int(np.ceil((makespan + settings.settle_s) * settings.physics_hz)))

    def fly(self, *, gui: bool) -> Execution:
        """Fly from the first step to the last."""
        step_s = 1.0 / self.settings.physics_hz
        states = np.empty((self.num_steps + 1, *self.state.shape))
        states[0] = self.state
        touches: list[Touch] = []
        with World(self.scene, self.vehicles, step_s, shape=self.settings.shape, gui=gui) as world:
            wall, begun = time.monotonic(), time.thread_time()
            for step in range(self.num_steps):
                self._control(step * step_s, step_s)
                touches += world.step(self.state, self.drive, self.spin, (step + 1) * step_s)
                states[step + 1] = self.state
                if gui:
                    time.sleep(max(0.0, wall + step * step_s - time.monotonic()))
            cpu_s = time.thread_time() - begun
        times = np.arange(self.num_steps + 1) * step_s
        return Execution(self.scene, self.flights, self.settings, times, states, tuple(touches), self.energy, cpu_s)

    def _control(self, now: float, step_s: float) -> None:
        settings = self.settings
        if settings.has_downwash:
            self.wind[:] = 0.0
            add_downwash(self.frames, self.state, self.wind)
        advance(
            self.reference, self.frames, self.frames, self.firmware, self.state, self.integrals, self.wind, self.drive,
            self.spin, self.energy, CONTROLLERS[settings.controller], settings.has_drag, now, step_s, settings.num_inner,
        )  # fmt: skip
