"""A geometric tracking controller that knows its rotors' lag, compiled, one drone at a time.

The attitude follows the thrust that the plan's acceleration asks for, with the body rates and angular accelerations that
its jerk and snap imply (differential flatness); errors are corrected on SE(3).

Sources: Lee, Leok and McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", 2010; drag in the feed-forward
as in Faessler, Franchi and Scaramuzza, "Differential flatness of quadrotor dynamics subject to rotor drag", 2018.
"""

from __future__ import annotations

from typing import Any, TypeAlias

from flockopt.batches.compiled import compiled_lazily
from flockopt.scene.scene import GRAVITY_MPS2
from sim.physics.quadrotor import Body, Rotors, acceleration_of, clipped, drag_force, lead_command, rotor_speed, total_thrust
from sim.physics.vectors import Axes, Vector, axes_of, cross, dot, minus, norm, plus, times, to_body, to_world

__all__ = ["Wanted", "geometric_command", "integrated_error", "mixed_thrusts"]

#: Damping of the position and the attitude loop, of critical.
POSITION_DAMPING, ATTITUDE_DAMPING = 0.9, 0.8

#: Yaw has little torque to spare: its loop is slower by this factor.
YAW_SHARE = 0.4

#: The integral of the position error grows at this share of the position rate, and its push is at most this, m/s**2.
INTEGRAL_SHARE, MOST_INTEGRAL_MPS2 = 0.15, 2.0

#: What a controller may ask of the thrust's direction: never less than this share of gravity, so that it stays defined.
LEAST_THRUST_SHARE = 0.1

EAST: Vector = (1.0, 0.0, 0.0)

#: Position, velocity, acceleration, jerk and snap of a plan.
Wanted: TypeAlias = tuple[Vector, Vector, Vector, Vector, Vector]


@compiled_lazily(error_model="numpy")
def integrated_error(frame: Any, integral: Vector, error: Vector, step_s: float) -> Vector:
    """The integral of the position error a step later, within what the controller may use of it (m s)."""
    most = MOST_INTEGRAL_MPS2 / (INTEGRAL_SHARE * frame.position_rate**3)
    return (
        clipped(integral[0] + step_s * error[0], -most, most),
        clipped(integral[1] + step_s * error[1], -most, most),
        clipped(integral[2] + step_s * error[2], -most, most),
    )


@compiled_lazily(error_model="numpy")
def geometric_command(frame: Any, body: Body, rpm: Rotors, wanted: Wanted, integral: Vector, has_drag: bool) -> Rotors:
    """Speeds to ask of the rotors, rpm.

    Args:
        frame: What the controller takes the drone for, a record of `sim.physics.vehicles.AIRFRAME`.
        body: State of the drone.
        rpm: The rotors' speeds.
        wanted: Position, velocity, acceleration, jerk and snap of the plan.
        integral: Of the position error, m s.
        has_drag: Whether to make up for drag (in still air).
    """
    position, attitude, velocity, rates = body
    axes = axes_of(attitude)
    rate, still = frame.position_rate, (0.0, 0.0, 0.0)
    stiffness, damping = rate * rate, 2.0 * POSITION_DAMPING * rate
    drag = drag_force(frame, axes, velocity) if has_drag else still
    error, slip = minus(wanted[0], position), minus(wanted[1], velocity)
    lag = minus(wanted[2], acceleration_of(frame, axes, total_thrust(frame, rpm), drag))
    correction = plus(plus(times(stiffness, error), times(damping, slip)), times(INTEGRAL_SHARE * rate**3, integral))
    push = plus(plus(wanted[2], correction), (0.0, 0.0, GRAVITY_MPS2))
    push = minus(push, times(1.0 / frame.mass, drag))
    if push[2] < LEAST_THRUST_SHARE * GRAVITY_MPS2:
        push = (push[0], push[1], LEAST_THRUST_SHARE * GRAVITY_MPS2)
    change = plus(wanted[3], plus(times(stiffness, slip), times(damping, lag)))
    if has_drag:
        change = minus(change, times(1.0 / frame.mass, drag_force(frame, axes, wanted[2])))
    desired, turning, spinning = _flat_attitude(push, change, wanted[4])
    torque = _attitude_torque(frame, axes, rates, desired, turning, spinning)
    thrusts = mixed_thrusts(frame, frame.mass * dot(push, axes[2]), torque)
    return (
        lead_command(frame, rpm[0], rotor_speed(frame, thrusts[0])),
        lead_command(frame, rpm[1], rotor_speed(frame, thrusts[1])),
        lead_command(frame, rpm[2], rotor_speed(frame, thrusts[2])),
        lead_command(frame, rpm[3], rotor_speed(frame, thrusts[3])),
    )


@compiled_lazily(error_model="numpy")
def _flat_attitude(push: Vector, change: Vector, change_rate: Vector) -> tuple[Axes, Vector, Vector]:
    """Axes, body rates and angular acceleration (in those axes) whose z axis follows a thrust and its two derivatives.

    The thrust is per mass, m/s**2; the nose keeps pointing east.
    """
    size = norm(push)
    up = times(1.0 / size, push)
    side = cross(up, EAST)
    level = norm(side)
    left = times(1.0 / level, side)
    front = cross(left, up)
    growth = dot(change, up)
    x, y = dot(change, front) / size, dot(change, left) / size  # how the z axis moves
    yaw = -dot(cross(plus(times(x, front), times(y, left)), EAST), front) / level
    bend_x = (dot(change_rate, front) - 2.0 * growth * x) / size
    bend_y = (dot(change_rate, left) - 2.0 * growth * y) / size
    return (front, left, up), (-y, x, yaw), (-bend_y + x * yaw, bend_x + y * yaw, 0.0)


@compiled_lazily(error_model="numpy")
def _attitude_torque(frame: Any, axes: Axes, rates: Vector, desired: Axes, turning: Vector, spinning: Vector) -> Vector:
    """Torque in the body's axes, N m, that brings them to the desired ones, which turn and spin up as given in their own."""
    twist = plus(plus(cross(axes[0], desired[0]), cross(axes[1], desired[1])), cross(axes[2], desired[2]))
    error = to_body(axes, times(0.5, twist))
    goal = to_body(axes, to_world(desired, turning))
    lead = minus(to_body(axes, to_world(desired, spinning)), cross(rates, goal))
    slip = minus(goal, rates)
    stiffness, damping = frame.attitude_rate**2, 2.0 * ATTITUDE_DAMPING * frame.attitude_rate
    a = frame.inertia[0] * (stiffness * error[0] + damping * slip[0] + lead[0])
    b = frame.inertia[1] * (stiffness * error[1] + damping * slip[1] + lead[1])
    c = frame.inertia[2] * (YAW_SHARE**2 * stiffness * error[2] + YAW_SHARE * damping * slip[2] + lead[2])
    momentum = (frame.inertia[0] * rates[0], frame.inertia[1] * rates[1], frame.inertia[2] * rates[2])
    return plus((a, b, c), cross(rates, momentum))


@compiled_lazily(error_model="numpy")
def mixed_thrusts(frame: Any, thrust: float, torque: Vector) -> Rotors:
    """Thrusts of the four rotors, N, that give a thrust and a torque, as near as they can.

    Roll and pitch come first: the thrust moves where a rotor would leave its range, and yaw gets what is left.
    """
    low, high = frame.least_thrust, frame.most_thrust
    roll, pitch = 0.25 * torque[0] / frame.arm, 0.25 * torque[1] / frame.arm
    room = 0.5 * (high - low)
    share = min(1.0, room / max(abs(roll) + abs(pitch), 1e-12))
    roll, pitch = share * roll, share * pitch
    tilting = abs(roll) + abs(pitch)
    mean = clipped(0.25 * thrust, low + tilting, high - tilting)
    spare = min(mean - tilting - low, high - mean - tilting)
    yaw = clipped(0.25 * torque[2] / frame.thrust_to_torque, -spare, spare)
    return mean - roll - pitch - yaw, mean - roll + pitch + yaw, mean + roll + pitch - yaw, mean + roll - pitch + yaw
