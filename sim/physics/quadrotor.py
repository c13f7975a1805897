"""Quadrotor dynamics, compiled: rotors with lag, thrust and torque, drag in moving air, and one small step of all of it.

The model is that of drone-models' ``first_principles`` (a test compares the two), without the rotors' own angular
momentum, which nearly cancels between the four of them.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

from flockopt.batches.compiled import compiled_lazily
from flockopt.scene.scene import GRAVITY_MPS2
from sim.physics.vectors import Axes, Quaternion, Vector, axes_of, cross, minus, plus, rotated, times, to_body, to_world

__all__ = [
    "Body", "Rotors", "acceleration_of", "clipped", "drag_force", "lead_command", "rotor_speed", "rotor_thrust", "shaft_power",
    "spun", "stepped", "torque_of", "total_thrust",
]  # fmt: skip

#: Position (m), attitude, velocity (m/s) in the world frame and body rates (rad/s) in the body's.
Body: TypeAlias = tuple[Vector, Quaternion, Vector, Vector]

#: Four rotors' speeds in rpm, or thrusts in N.
Rotors: TypeAlias = tuple[float, float, float, float]

RADIANS_PER_SECOND_OF_RPM = math.pi / 30.0


@compiled_lazily(error_model="numpy")
def clipped(value: float, low: float, high: float) -> float:
    """The nearest number within [low, high]."""
    return min(max(value, low), high)


@compiled_lazily(error_model="numpy")
def rotor_thrust(frame: Any, rpm: float) -> float:
    """Thrust of one rotor, N."""
    return frame.thrust_curve[0] + rpm * (frame.thrust_curve[1] + rpm * frame.thrust_curve[2])


@compiled_lazily(error_model="numpy")
def rotor_torque(frame: Any, rpm: float) -> float:
    """Drag torque of one rotor, N m."""
    return frame.torque_curve[0] + rpm * (frame.torque_curve[1] + rpm * frame.torque_curve[2])


@compiled_lazily(error_model="numpy")
def rotor_speed(frame: Any, thrust: float) -> float:
    """The rpm at which one rotor gives this thrust."""
    zero, slope, square = frame.thrust_curve
    return (-slope + math.sqrt(slope * slope - 4.0 * square * (zero - thrust))) / (2.0 * square)


@compiled_lazily(error_model="numpy")
def total_thrust(frame: Any, rpm: Rotors) -> float:
    """Thrust of all four rotors along the body's z axis, N."""
    return rotor_thrust(frame, rpm[0]) + rotor_thrust(frame, rpm[1]) + rotor_thrust(frame, rpm[2]) + rotor_thrust(frame, rpm[3])


@compiled_lazily(error_model="numpy")
def torque_of(frame: Any, rpm: Rotors) -> Vector:
    """Torque of the rotors about the body's axes, N m; signs as in `sim.physics.vehicles.MIXING`."""
    a, b, c, d = (
        rotor_thrust(frame, rpm[0]), rotor_thrust(frame, rpm[1]), rotor_thrust(frame, rpm[2]), rotor_thrust(frame, rpm[3]),
    )  # fmt: skip
    yaw = rotor_torque(frame, rpm[1]) - rotor_torque(frame, rpm[0]) + rotor_torque(frame, rpm[3]) - rotor_torque(frame, rpm[2])
    return frame.arm * (c + d - a - b), frame.arm * (b + c - a - d), yaw


@compiled_lazily(error_model="numpy")
def shaft_power(frame: Any, rpm: Rotors) -> float:
    """Mechanical power of the rotors, W."""
    power = 0.0
    for speed in rpm:
        power += rotor_torque(frame, speed) * speed * RADIANS_PER_SECOND_OF_RPM
    return power


@compiled_lazily(error_model="numpy")
def spun(frame: Any, rpm: Rotors, command: Rotors, step_s: float) -> Rotors:
    """The rotors' speeds a step later, asked for the speeds of the command."""
    return (
        rpm[0] + step_s * _spin_rate(frame, rpm[0], command[0]),
        rpm[1] + step_s * _spin_rate(frame, rpm[1], command[1]),
        rpm[2] + step_s * _spin_rate(frame, rpm[2], command[2]),
        rpm[3] + step_s * _spin_rate(frame, rpm[3], command[3]),
    )


@compiled_lazily(error_model="numpy")
def _spin_rate(frame: Any, rpm: float, command: float) -> float:
    gain = frame.spin_up if command > rpm else frame.spin_down
    return (command - rpm) * (gain[0] + gain[1] * (command + rpm))


@compiled_lazily(error_model="numpy")
def lead_command(frame: Any, rpm: float, target: float) -> float:
    """The command at which a rotor nears its target speed at the rate ``rotor_rate``, however slow the rotor is by itself.

    It inverts `_spin_rate`; what a rotor cannot be asked for (its least and most thrust) is clipped.
    """
    wanted = frame.rotor_rate * (target - rpm)
    linear, square = frame.spin_up if wanted > 0.0 else frame.spin_down
    if square == 0.0:
        command = rpm + wanted / linear
    else:
        root = linear * linear + 4.0 * square * (rpm * (linear + square * rpm) + wanted)
        command = (-linear + math.sqrt(max(root, 0.0))) / (2.0 * square)
    return clipped(command, frame.least_rpm, frame.most_rpm)


@compiled_lazily(error_model="numpy")
def drag_force(frame: Any, axes: Axes, air_velocity: Vector) -> Vector:
    """Drag in the world frame, N, at a velocity through the air."""
    u, v, w = to_body(axes, air_velocity)
    return to_world(axes, (-frame.drag[0] * u, -frame.drag[1] * v, -frame.drag[2] * w))


@compiled_lazily(error_model="numpy")
def acceleration_of(frame: Any, axes: Axes, thrust: float, drag: Vector) -> Vector:
    """Of the centre of mass, m/s**2."""
    force = plus(times(thrust, axes[2]), drag)
    return plus(times(1.0 / frame.mass, force), (0.0, 0.0, -GRAVITY_MPS2))


@compiled_lazily(error_model="numpy")
def stepped(frame: Any, body: Body, rpm: Rotors, wind: Vector, has_drag: bool, step_s: float) -> Body:
    """The body a step later under its rotors, gravity and drag; positions to second order, rates to first."""
    position, attitude, velocity, rates = body
    axes = axes_of(attitude)
    drag = drag_force(frame, axes, minus(velocity, wind)) if has_drag else (0.0, 0.0, 0.0)
    faster = plus(velocity, times(step_s, acceleration_of(frame, axes, total_thrust(frame, rpm), drag)))
    torque, inertia = torque_of(frame, rpm), (frame.inertia[0], frame.inertia[1], frame.inertia[2])
    gyroscopic = cross(rates, (inertia[0] * rates[0], inertia[1] * rates[1], inertia[2] * rates[2]))
    turning = (
        rates[0] + step_s * (torque[0] - gyroscopic[0]) / inertia[0],
        rates[1] + step_s * (torque[1] - gyroscopic[1]) / inertia[1],
        rates[2] + step_s * (torque[2] - gyroscopic[2]) / inertia[2],
    )
    middle = times(0.5 * step_s, plus(velocity, faster))
    return plus(position, middle), rotated(attitude, times(0.5 * step_s, plus(rates, turning))), faster, turning
