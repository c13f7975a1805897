"""One physics step of a whole fleet, compiled: where drones should be, what their controllers ask, how they answer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.compiled import compiled_lazily
from flockopt.records.arrays import FloatArray
from sim.physics.controller import geometric_command, integrated_error
from sim.physics.mellinger import mellinger_command
from sim.physics.quadrotor import Body, Rotors, shaft_power, spun, stepped, total_thrust
from sim.physics.reference import Reference, state_at
from sim.physics.vectors import minus, times, turn_between

__all__ = ["CONTROLLERS", "POSE", "RATES", "ROTORS", "STATE_WIDTH", "VELOCITY", "add_downwash", "advance"]

#: Columns of a fleet's states (N, 17): position and attitude, velocity, body rates, rotor speeds (rpm).
POSE, VELOCITY, RATES, ROTORS = slice(0, 7), slice(7, 10), slice(10, 13), slice(13, 17)
STATE_WIDTH = 17

#: Controllers by name, numbered for compiled code.
CONTROLLERS = {"geometric": 0, "mellinger": 1}
GEOMETRIC = CONTROLLERS["geometric"]

AIR_DENSITY_KGPM3 = 1.2

#: A round turbulent jet: its speed falls with distance from this many of its diameters on, and it widens (half width per
#: distance where the speed is 1/e); Pope, "Turbulent Flows", 2000, section 5.1.
JET_CORE_DIAMETERS, JET_WIDTH = 6.0, 0.113


@compiled_lazily(error_model="numpy")
def advance(
    reference: Reference,
    truth: NDArray[Any],
    model: NDArray[Any],
    firmware: NDArray[Any],
    states: FloatArray,
    integrals: FloatArray,
    wind: FloatArray,
    drive: FloatArray,
    spin: FloatArray,
    energy: FloatArray,
    controller: int,
    has_drag: bool,
    time: float,
    step_s: float,
    num_inner: int,
) -> None:
    """Move a fleet on by one step of the physics, in inner steps of its control.

    Args:
        reference: The plan.
        truth: (N,) records of `sim.physics.vehicles.AIRFRAME`: the drones.
        model: (N,) likewise: what their controllers take them for.
        firmware: (N,) records of `sim.physics.mellinger.MELLINGER`; read only where that controller flies.
        states: (N, 17), see `POSE`; brought up to date.
        integrals: (N, 3) m s, of the position errors; brought up to date.
        wind: (N, 3) m/s, of the air around each drone.
        drive: (N, 3) out: mean velocity of each drone over the step, m/s.
        spin: (N, 3) out: its mean turning, rad/s in the world frame.
        energy: (N,) J, of the rotors' shafts; added to.
        controller: One of `CONTROLLERS`.
        has_drag: Whether air resists.
        time: At the beginning of the step, s.
        step_s: The step, s.
        num_inner: Into how many inner steps it is cut.
    """
    inner_s = step_s / num_inner
    for i in range(states.shape[0]):
        body, rpm = _unpacked(states, i)
        begun = body
        air = (wind[i, 0], wind[i, 1], wind[i, 2])
        integral = (integrals[i, 0], integrals[i, 1], integrals[i, 2])
        for inner in range(num_inner):
            wanted = state_at(reference, i, time + inner * inner_s)
            if controller == GEOMETRIC:
                integral = integrated_error(model[i], integral, minus(wanted[0], body[0]), inner_s)
                command = geometric_command(model[i], body, rpm, wanted, integral, has_drag)
            else:
                command = mellinger_command(model[i], firmware[i], body, wanted, inner_s)
            rpm = spun(truth[i], rpm, command, inner_s)
            body = stepped(truth[i], body, rpm, air, has_drag, inner_s)
            energy[i] += inner_s * shaft_power(truth[i], rpm)
        integrals[i, 0], integrals[i, 1], integrals[i, 2] = integral
        mean = times(1.0 / step_s, minus(body[0], begun[0]))
        turn = times(1.0 / step_s, turn_between(begun[1], body[1]))
        for axis in range(3):
            drive[i, axis], spin[i, axis] = mean[axis], turn[axis]
        _pack(states, i, body, rpm)


@compiled_lazily(error_model="numpy")
def _unpacked(states: FloatArray, i: int) -> tuple[Body, Rotors]:
    row = states[i]
    body = (
        (row[0], row[1], row[2]), (row[3], row[4], row[5], row[6]), (row[7], row[8], row[9]), (row[10], row[11], row[12]),
    )  # fmt: skip
    return body, (row[13], row[14], row[15], row[16])


@compiled_lazily(error_model="numpy")
def _pack(states: FloatArray, i: int, body: Body, rpm: Rotors) -> None:
    for axis in range(3):
        states[i, axis], states[i, 7 + axis], states[i, 10 + axis] = body[0][axis], body[2][axis], body[3][axis]
    for part in range(4):
        states[i, 3 + part], states[i, 13 + part] = body[1][part], rpm[part]


@compiled_lazily(error_model="numpy")
def add_downwash(truth: NDArray[Any], states: FloatArray, wind: FloatArray) -> None:
    """Add to the air around each drone the jets of those above it.

    A drone's rotors blow one round jet: momentum theory gives its speed, its area is what the streams contract to.
    """
    for upper in range(len(states)):
        frame, (body, rpm) = truth[upper], _unpacked(states, upper)
        area = 4.0 * math.pi * frame.rotor_radius**2
        thrust = max(total_thrust(frame, rpm), 0.0)
        speed = 2.0 * math.sqrt(thrust / (2.0 * AIR_DENSITY_KGPM3 * area))
        diameter = math.sqrt(2.0 * area / math.pi)
        for lower in range(len(states)):
            below = body[0][2] - states[lower, 2]
            if lower != upper and below > 0.0:
                flat = np.hypot(states[lower, 0] - body[0][0], states[lower, 1] - body[0][1])
                wind[lower, 2] -= _jet_speed(speed, diameter, below, flat)


@compiled_lazily(error_model="numpy")
def _jet_speed(speed: float, diameter: float, below: float, aside: float) -> float:
    """Downward speed of the air in a jet, m/s."""
    width = max(0.5 * diameter, JET_WIDTH * below)
    middle = speed * min(1.0, JET_CORE_DIAMETERS * diameter / below)
    return middle * math.exp(-((aside / width) ** 2))
