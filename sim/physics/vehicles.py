"""The drones that can be flown: Crazyflie 2.x variants and a 2 kg class, as numbers for compiled code.

The Crazyflies' numbers are those of the package drone-models 0.1.0 (learnsyslab), which identified them from flights and
test stands; a test compares them. The 2 kg class is no product: a plausible 15-inch quadrotor, thrust twice its weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SettingsError
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene
from flockopt.scene.scene import GRAVITY_MPS2

__all__ = ["AIRFRAME", "MIXING", "VEHICLES", "Vehicle", "airframes", "hover_speeds", "vehicle_names", "vehicles_of"]

#: Signs of each rotor's thrust in roll and pitch, and of its drag in yaw: an X with the first rotor front right.
MIXING = ((-1.0, -1.0, 1.0, 1.0), (-1.0, 1.0, 1.0, -1.0), (-1.0, 1.0, -1.0, 1.0))

#: Drones that weigh less (kg) are Crazyflies; where the scene does not say, those whose collision ball is smaller (metres).
HEAVIEST_CRAZYFLIE_KG, LARGEST_CRAZYFLIE_M = 0.25, 0.2

#: A row of numbers for each drone that compiled code reads by name; fields as in `Vehicle`,
#: and the speeds of a rotor at its least and most thrust.
AIRFRAME = np.dtype(
    [
        ("mass", "f8"), ("inertia", "f8", (3,)), ("arm", "f8"), ("thrust_curve", "f8", (3,)), ("torque_curve", "f8", (3,)),
        ("thrust_to_torque", "f8"), ("spin_up", "f8", (2,)), ("spin_down", "f8", (2,)), ("drag", "f8", (3,)),
        ("least_thrust", "f8"), ("most_thrust", "f8"), ("rotor_radius", "f8"),
        ("rotor_rate", "f8"), ("attitude_rate", "f8"), ("position_rate", "f8"), ("least_rpm", "f8"), ("most_rpm", "f8"),
    ]
)  # fmt: skip


@dataclass(frozen=True)
class Vehicle:
    """A quadrotor and how tightly it is controlled.

    Attributes:
        mass: kg.
        inertia: kg m**2 about the body's axes.
        arm: Of each rotor's thrust about the roll and the pitch axis, metres.
        thrust_curve: A rotor's thrust in N is c[0] + c[1] rpm + c[2] rpm**2.
        torque_curve: Its drag torque in N m, likewise.
        thrust_to_torque: Metres, what a controller takes for their ratio.
        spin_up: A rotor asked for more follows d(rpm)/dt = k[0] (cmd - rpm) + k[1] (cmd**2 - rpm**2), per second.
        spin_down: The same where it is asked for less.
        drag: N per m/s of air speed along the body's axes.
        least_thrust: Of one rotor, N.
        most_thrust: Of one rotor, N.
        rotor_radius: m.
        rotor_rate: 1/s, how fast the controller drives rotors to their speeds, ahead of their lag.
        attitude_rate: rad/s, natural frequency of the attitude loop.
        position_rate: rad/s, natural frequency of the position loop.
    """

    mass: float
    inertia: tuple[float, float, float]
    arm: float
    thrust_curve: tuple[float, float, float]
    torque_curve: tuple[float, float, float]
    thrust_to_torque: float
    spin_up: tuple[float, float]
    spin_down: tuple[float, float]
    drag: tuple[float, float, float]
    least_thrust: float
    most_thrust: float
    rotor_radius: float
    rotor_rate: float = 60.0
    attitude_rate: float = 18.0
    position_rate: float = 6.0

    @property
    def hover_rpm(self) -> float:
        """Speed of every rotor in still hover."""
        return self.rpm(self.mass * GRAVITY_MPS2 / 4.0)

    def rpm(self, thrust: float) -> float:
        """The speed at which one rotor gives this thrust (N)."""
        zero, slope, square = self.thrust_curve
        return (-slope + math.sqrt(slope * slope - 4.0 * square * (zero - thrust))) / (2.0 * square)

    def fitted(self, drone: Drone) -> Vehicle:
        """This vehicle with the mass and the largest thrust that a scene gives for a drone, where it does."""
        fitted = self
        if drone.mass is not None:
            share = drone.mass / self.mass
            fitted = replace(
                fitted, mass=drone.mass, inertia=_scaled(self.inertia, share), drag=_scaled(self.drag, share),
                thrust_curve=_scaled(self.thrust_curve, share), torque_curve=_scaled(self.torque_curve, share),
                least_thrust=self.least_thrust * share, most_thrust=self.most_thrust * share,
            )  # fmt: skip
        return fitted if drone.max_thrust is None else replace(fitted, most_thrust=drone.max_thrust / 4.0)


def _scaled(values: tuple[float, ...], factor: float) -> Any:
    return tuple(value * factor for value in values)


VEHICLES: Mapping[str, Vehicle] = MappingProxyType(
    {
        "cf2x_L250": Vehicle(
            mass=0.0319, inertia=(16.8e-6, 16.8e-6, 29.8e-6), arm=0.03253,
            thrust_curve=(0.0, -5.382196214637237e-7, 2.4582929831265485e-10),
            torque_curve=(0.0, 1.410454111996297e-9, 1.4592584373980652e-12), thrust_to_torque=0.007350862856566459,
            spin_up=(7.355623702172756, 0.0), spin_down=(0.0, 0.00024443862952110715),
            drag=(0.01471782, 0.01471782, 0.01277641),
            least_thrust=0.012817578393224994, most_thrust=0.12, rotor_radius=23.55e-3,
        ),
        "cf2x_P250": Vehicle(
            mass=0.0318, inertia=(16.8e-6, 16.8e-6, 29.8e-6), arm=0.03253,
            thrust_curve=(0.0, -3.6200226530383495e-7, 1.6060924304100328e-10),
            torque_curve=(0.0, -2.2665265829562245e-9, 1.1149485566919186e-12), thrust_to_torque=0.0069928948992470565,
            spin_up=(5.172596691828673, 8.14774234381285e-5), spin_down=(0.0, 0.0002095253491455741),
            drag=(0.01351483, 0.01351483, 0.01677452),
            least_thrust=0.012817578393224994, most_thrust=0.12, rotor_radius=23.4e-3,
        ),
        "cf2x_T350": Vehicle(
            mass=0.0379, inertia=(16.8e-6, 16.8e-6, 29.8e-6), arm=0.03253,
            thrust_curve=(0.0, -7.167227176573658e-7, 2.9401303690194613e-10),
            torque_curve=(0.0, 5.815894847811497e-10, 1.331813874166509e-12), thrust_to_torque=0.005355990836477486,
            spin_up=(11.374753209400291, 0.0), spin_down=(0.0, 0.00037867688499079635),
            drag=(0.01556697, 0.01556697, 0.02191672),
            least_thrust=0.01922636758983749, most_thrust=0.18, rotor_radius=25.4e-3,
        ),
        "cf21B_500": Vehicle(
            mass=0.04338, inertia=(25e-6, 28e-6, 49e-6), arm=0.035355,
            thrust_curve=(0.0, -3.133427287299859e-7, 4.407354891648379e-10),
            torque_curve=(0.0, 1.65886356219615e-9, 2.4693477924534137e-12), thrust_to_torque=0.00593893393599368,
            spin_up=(13.996001897562685, 0.00011093207920685363), spin_down=(5.933168530682111, 0.00031951312393561264),
            drag=(0.02149163, 0.02149163, 0.02359736),
            least_thrust=0.02136263065537499, most_thrust=0.2, rotor_radius=27.5e-3,
        ),
        "quad_2kg": Vehicle(
            mass=2.0, inertia=(0.022, 0.022, 0.04), arm=0.16, thrust_curve=(0.0, 0.0, 2.4e-7), torque_curve=(0.0, 0.0, 3.8e-9),
            thrust_to_torque=3.8e-9 / 2.4e-7, spin_up=(14.0, 0.0), spin_down=(0.0, 0.0014), drag=(0.25, 0.25, 0.35),
            least_thrust=0.4, most_thrust=10.0, rotor_radius=0.19, rotor_rate=50.0, attitude_rate=14.0, position_rate=5.0,
        ),
    }
)  # fmt: skip


def vehicles_of(scene: Scene, name: str | None = None) -> list[Vehicle]:
    """A vehicle for every drone of the scene.

    Args:
        scene: The scene.
        name: One of `VEHICLES` for all of them; None chooses by each drone's mass or radius: a Crazyflie with thrust to spare
            (cf2x_T350) or the 2 kg class. What a scene says of a drone's mass and thrust counts either way.

    Raises:
        SettingsError: If there is no such vehicle.
    """
    names = vehicle_names(scene, name)
    return [VEHICLES[kind].fitted(drone) for kind, drone in zip(names, scene.drones, strict=True)]


def vehicle_names(scene: Scene, name: str | None = None) -> list[str]:
    """Which vehicle each drone of the scene is; arguments and errors as in `vehicles_of`."""
    if name is not None:
        checks.choice(SettingsError, "vehicle", name, known=VEHICLES)
    return [name or _suited(drone) for drone in scene.drones]


def _suited(drone: Drone) -> str:
    is_small = drone.radius < LARGEST_CRAZYFLIE_M if drone.mass is None else drone.mass < HEAVIEST_CRAZYFLIE_KG
    return "cf2x_T350" if is_small else "quad_2kg"


def airframes(vehicles: list[Vehicle]) -> NDArray[Any]:
    """The vehicles as (N,) records of `AIRFRAME`."""
    rows = [(*astuple(kind), kind.rpm(kind.least_thrust), kind.rpm(kind.most_thrust)) for kind in vehicles]
    return np.array(rows, dtype=AIRFRAME)


def hover_speeds(vehicles: list[Vehicle]) -> FloatArray:
    """(N, 4) rpm of all rotors in still hover."""
    return np.array([[vehicle.hover_rpm] * 4 for vehicle in vehicles])
