"""The Crazyflie firmware's Mellinger controller, compiled, one drone at a time.

It gives what the package drone-controllers 0.1.0 (learnsyslab) gives, number for number; a test compares thrust and torque.
It knows neither rotor lag nor drag and lags behind fast plans: it is here to be compared with.

Source: Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011, as the firmware has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.errors import SettingsError
from flockopt.scene import Scene
from sim.physics.controller import Wanted
from sim.physics.quadrotor import Body, Rotors, clipped, rotor_speed
from sim.physics.vectors import Axes, Vector, axes_of, cross, dot, minus, norm, plus, times

__all__ = ["BELIEVED_MASS_KG", "MELLINGER", "mellinger_command", "mellinger_wrench", "tunings"]

#: What the firmware takes the mass for; it is not the true one.
BELIEVED_MASS_KG = MappingProxyType({"cf2x_L250": 0.029, "cf2x_P250": 0.029, "cf2x_T350": 0.0325, "cf21B_500": 0.0393})

#: Gravity as the firmware has it.
GRAVITY_MPS2 = 9.81

#: The motors' command: a pulse width of 16 bits, never less than the least once they turn.
LEAST_PWM, MOST_PWM = 7000.0, 65535.0

#: Pulse width for each newton of all thrust, whatever the drone weighs.
PWM_OF_THRUST = 132000.0

POSITION_GAIN: Vector = (0.4, 0.4, 1.25)
VELOCITY_GAIN: Vector = (0.2, 0.2, 0.5)
INTEGRAL_GAIN = 0.05
MOST_INTEGRAL: Vector = (2.0, 2.0, 0.4)

ATTITUDE_GAIN: Vector = (70000.0, 70000.0, 60000.0)
RATE_GAIN: Vector = (20000.0, 20000.0, 12000.0)
RATE_CHANGE_GAIN: Vector = (200.0, 200.0, 0.0)
YAW_INTEGRAL_GAIN, MOST_YAW_INTEGRAL = 500.0, 1500.0
MOST_TORQUE_PWM = 32000.0

EAST: Vector = (1.0, 0.0, 0.0)

#: What differs from drone to drone, and what the controller remembers from call to call: the integrals of the position
#: error (m s) and of the yaw error (rad s), and the last body rates (rad/s).
MELLINGER = np.dtype([("mass", "f8"), ("arm", "f8"), ("thrust_to_torque", "f8"), ("most_thrust", "f8"),
                      ("integral", "f8", (3,)), ("yaw_integral", "f8"), ("last_rates", "f8", (3,))])  # fmt: skip


def tunings(scene: Scene, names: Sequence[str], frames: NDArray[Any]) -> NDArray[Any]:
    """The controllers of a scene's drones, (N,) records of `MELLINGER`.

    Raises:
        SettingsError: If a drone is no Crazyflie: the firmware has no gains for it.
    """
    records = np.zeros(len(frames), dtype=MELLINGER)
    for i, (drone, name) in enumerate(zip(scene.drones, names, strict=True)):
        if name not in BELIEVED_MASS_KG:
            rule = f"flies only {', '.join(BELIEVED_MASS_KG)}, and drone {drone.id} is a {name}"
            raise SettingsError("controller", "is 'mellinger'", rule, "choose 'geometric' or another vehicle")
        records[i]["mass"] = BELIEVED_MASS_KG[name]
    for field in ("arm", "thrust_to_torque", "most_thrust"):
        records[field] = frames[field]
    return records


@compiled_lazily(error_model="numpy")
def mellinger_command(frame: Any, own: Any, body: Body, wanted: Wanted, step_s: float) -> Rotors:
    """Speeds to ask of the rotors, rpm; ``own`` is the drone's record of `MELLINGER`, which is brought up to date."""
    thrust, torque = mellinger_wrench(own, body, wanted[0], wanted[1], wanted[2], step_s)
    roll, pitch, yaw = torque[0] / own.arm, torque[1] / own.arm, torque[2] / own.thrust_to_torque
    low, high = own.most_thrust * LEAST_PWM / MOST_PWM, own.most_thrust
    return (
        rotor_speed(frame, clipped(0.25 * (thrust - roll - pitch - yaw), low, high)),
        rotor_speed(frame, clipped(0.25 * (thrust - roll + pitch + yaw), low, high)),
        rotor_speed(frame, clipped(0.25 * (thrust + roll + pitch - yaw), low, high)),
        rotor_speed(frame, clipped(0.25 * (thrust + roll - pitch + yaw), low, high)),
    )


@compiled_lazily(error_model="numpy")
def mellinger_wrench(
    own: Any, body: Body, position: Vector, velocity: Vector, acceleration: Vector, step_s: float
) -> tuple[float, Vector]:
    """Thrust (N) and torque (N m) that the firmware asks for, its yaw kept at zero."""
    axes, rates = axes_of(body[1]), body[3]
    error, slip = minus(position, body[0]), minus(velocity, body[2])
    push = times(own.mass, plus(acceleration, (0.0, 0.0, GRAVITY_MPS2)))
    total = [0.0, 0.0, 0.0]
    for axis in range(3):
        grown = own.integral[axis] + step_s * error[axis]
        own.integral[axis] = clipped(grown, -MOST_INTEGRAL[axis], MOST_INTEGRAL[axis])
        total[axis] = push[axis] + POSITION_GAIN[axis] * error[axis] + VELOCITY_GAIN[axis] * slip[axis]
        total[axis] += INTEGRAL_GAIN * own.integral[axis]
    push = (total[0], total[1], total[2])
    mean = PWM_OF_THRUST * dot(push, axes[2])
    return _achieved(own, mean, _torque_pwm(own, axes, _desired_axes(push), rates, step_s, mean > 0.0))


@compiled_lazily(error_model="numpy")
def _desired_axes(push: Vector) -> Axes:
    up = times(1.0 / norm(push), push)
    left = cross(up, EAST)
    left = times(1.0 / norm(left), left)
    return cross(left, up), left, up


@compiled_lazily(error_model="numpy")
def _torque_pwm(own: Any, axes: Axes, desired: Axes, rates: Vector, step_s: float, is_on: bool) -> Vector:
    error = (
        dot(desired[2], axes[1]) - dot(desired[1], axes[2]),
        dot(desired[0], axes[2]) - dot(desired[2], axes[0]),
        dot(desired[1], axes[0]) - dot(desired[0], axes[1]),
    )
    own.yaw_integral = clipped(own.yaw_integral - step_s * error[2], -MOST_YAW_INTEGRAL, MOST_YAW_INTEGRAL)
    torque = [0.0, 0.0, YAW_INTEGRAL_GAIN * own.yaw_integral]
    for axis in range(3):
        change = (rates[axis] - own.last_rates[axis]) / step_s
        torque[axis] -= ATTITUDE_GAIN[axis] * error[axis] + RATE_GAIN[axis] * rates[axis] + RATE_CHANGE_GAIN[axis] * change
        torque[axis] = clipped(torque[axis], -MOST_TORQUE_PWM, MOST_TORQUE_PWM) if is_on else 0.0
        own.last_rates[axis] = rates[axis]
    return torque[0], torque[1], torque[2]


@compiled_lazily(error_model="numpy")
def _achieved(own: Any, mean: float, pwm: Vector) -> tuple[float, Vector]:
    """Thrust and torque that four pulse widths give, each cut to what a motor takes."""
    roll, pitch, yaw = 0.5 * pwm[0], 0.5 * pwm[1], pwm[2]
    newtons = own.most_thrust / MOST_PWM
    a = newtons * clipped(mean - roll - pitch - yaw, LEAST_PWM, MOST_PWM)
    b = newtons * clipped(mean - roll + pitch + yaw, LEAST_PWM, MOST_PWM)
    c = newtons * clipped(mean + roll + pitch - yaw, LEAST_PWM, MOST_PWM)
    d = newtons * clipped(mean + roll - pitch + yaw, LEAST_PWM, MOST_PWM)
    torque = (own.arm * (c + d - a - b), own.arm * (b + c - a - d), own.thrust_to_torque * (b + d - a - c))
    return a + b + c + d, torque
