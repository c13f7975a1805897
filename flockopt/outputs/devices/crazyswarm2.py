"""Plans for Crazyflies under Crazyswarm2: a CSV of polynomials for each drone, and the YAML that lists the fleet.

The CSV is what Crazyswarm2's ``Trajectory.loadcsv`` reads: a piece a row, its duration, then eight coefficients each of
x, y, z and yaw. A drone that departs late waits in a first piece that stands still. Every CSV is read back and flown as
the firmware flies it, in single precision, and compared with the plan.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.certificate import Plan
from flockopt.certificate.plan_file import LARGEST_DEGREE
from flockopt.errors import PlanError, require
from flockopt.flights import Curve
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

__all__ = ["FLEET_FILE", "MOST_PIECES", "convert", "fly_as_firmware", "read_rows", "read_trajectory", "trajectory_csv", "yaml"]

#: Of a Crazyflie's trajectory memory, and of a piece in it: four polynomials of degree 7 and a duration in floats.
MEMORY_BYTES, PIECE_BYTES = 4096, 4 * (4 * (LARGEST_DEGREE + 1) + 1)
MOST_PIECES = MEMORY_BYTES // PIECE_BYTES

#: What is read back may differ from the plan by this much.
POSITION_TOLERANCE_M = 1e-3

#: Times in every piece at which it is compared.
SAMPLES_PER_PIECE = 64

FLEET_FILE = "crazyflies.yaml"
ROBOT_TYPE = "crazyflie"

#: The first drone's radio address is one more than this; see docs/export.md for how to set one's own.
BASE_ADDRESS = 0xE7E7E7E700

HEADER = ("duration", *(f"{axis}^{n}" for axis in ("x", "y", "z", "yaw") for n in range(LARGEST_DEGREE + 1)))

#: ROS 2 takes such names for the parts of a topic.
ROS_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")

SingleArray = NDArray[np.float32]


def convert(plan: Plan, scene: Scene | None) -> tuple[dict[str, str], list[str]]:
    """Contents by file name, and what does not fit the device.

    Args:
        plan: What to fly.
        scene: Its scene, which tells where the drones are that do not move; or None.

    Raises:
        MissingExtra: If PyYAML is not installed.
    """
    files, misfits = {}, []
    for drone, flight in plan.flights.items():
        rows = trajectory_rows(flight.curve)
        content = trajectory_csv(rows)
        misfit = _misfit(drone, flight.curve, rows, content)
        if misfit:
            misfits.append(f"drone {drone} {misfit}")
        files[f"{drone}.csv"] = content
    names = list(plan.flights) + [drone for drone in plan.routes if drone not in plan.flights]
    places: dict[str, FloatArray | None] = dict.fromkeys(names)
    if scene is not None:
        places = {drone.id: np.array(drone.start) for drone in scene.drones}
    places |= {drone: flight.curve(flight.curve.start_time) for drone, flight in plan.flights.items()}
    parked = [drone for drone in places if drone not in plan.flights]
    misfits += [f"drone {drone} {_name_misfit(drone)}" for drone in parked if _name_misfit(drone)]
    files[FLEET_FILE] = _fleet(places)
    return files, misfits


def trajectory_rows(curve: Curve) -> FloatArray:
    """A row for each piece, (K, 33): its duration, then 8 coefficients of x, y, z and yaw; yaw is 0."""
    waits = curve.start_time > 0.0
    rows = np.zeros((curve.num_pieces + waits, len(HEADER)))
    rows[:, 0] = np.diff(curve.breakpoints, prepend=[0.0] if waits else [])
    num_terms = min(curve.coefficients.shape[2], LARGEST_DEGREE + 1)
    terms = rows[:, 1:].reshape(len(rows), 4, LARGEST_DEGREE + 1)
    terms[int(waits) :, :3, :num_terms] = curve.coefficients[:, :, :num_terms]
    if waits:
        terms[0, :3, 0] = curve.coefficients[0, :, 0]
    rows[:, 1:] = terms.reshape(len(rows), -1)
    return rows


def trajectory_csv(rows: FloatArray) -> str:
    """The text of a trajectory file; numbers read back exactly."""
    lines = [",".join(HEADER), *(",".join(repr(float(value) + 0.0) for value in row) for row in rows)]  # + 0.0: no -0.0
    return "\n".join(lines) + "\n"


def read_trajectory(text: str) -> FloatArray:
    """The rows (K, 33) of a trajectory file, read strictly.

    Raises:
        PlanError: If it is not one.
    """
    lines = text.splitlines()
    if not lines or lines[0].split(",") != list(HEADER):
        raise PlanError("header", "is another one", f"must be {HEADER[0]}, {HEADER[1]}, ..., {HEADER[-1]}", "export anew")
    return read_rows(lines[1:])


def read_rows(lines: Sequence[str]) -> FloatArray:
    """The pieces (K, 33) on the lines of a trajectory file.

    Raises:
        PlanError: If one is no piece, or there is none.
    """
    rows = []
    for number, line in enumerate(lines):
        try:
            row = [float(value) for value in line.split(",")]
        except ValueError:
            row = []
        if len(row) != len(HEADER) or not np.isfinite(row).all() or not row[0] > 0.0:
            rule = f"must be {len(HEADER)} finite numbers: a duration > 0, then 8 coefficients each of x, y, z and yaw"
            raise PlanError(f"rows[{number}]", f"is {line[:40]!r}", rule, "write the file anew")
        rows.append(row)
    if not rows:
        raise PlanError("rows", "are missing", "a trajectory has a piece at least", "write the file anew")
    return np.array(rows)


def fly_as_firmware(rows: FloatArray, times: FloatArray) -> FloatArray:
    """Positions (T, 3) m at times (T,) s since the start, in single precision and piece by piece as on the device."""
    single: SingleArray = rows.astype(np.float32)
    since: SingleArray = times.astype(np.float32)
    piece = np.zeros(len(since), dtype=int)
    for k in range(len(single) - 1):
        over = (piece == k) & (since > single[k, 0])
        since[over] -= single[k, 0]
        piece[over] = k + 1
    since = np.minimum(since, single[piece, 0])  # after the last piece it hovers where that ended
    terms = single[:, 1:].reshape(len(single), 4, LARGEST_DEGREE + 1)[piece, :3]  # (T, 3, 8)
    values = np.zeros((len(since), 3), dtype=np.float32)
    for n in range(LARGEST_DEGREE, -1, -1):
        values = values * since[:, None] + terms[:, :, n]
    return values.astype(np.float64)


def _misfit(drone: str, curve: Curve, rows: FloatArray, content: str) -> str:
    """Why a drone cannot fly its trajectory; empty if it can."""
    if _name_misfit(drone):
        return _name_misfit(drone)
    if len(rows) > MOST_PIECES:
        waiting = ", one of them to wait" if curve.start_time > 0.0 else ""
        return (
            f"has {len(rows)} pieces{waiting}; a Crazyflie stores {MOST_PIECES} ({PIECE_BYTES} bytes each, of {MEMORY_BYTES});"
            " plan again with fewer tasks a drone, or fewer pieces"
        )
    share = np.linspace(0.0, 1.0, SAMPLES_PER_PIECE)
    starts = np.concatenate([[0.0], np.cumsum(rows[:-1, 0])])
    times = np.append((starts[:, None] + rows[:, :1] * share).ravel(), curve.end_time + 1.0)
    away = np.linalg.norm(fly_as_firmware(read_trajectory(content), times) - curve(times), axis=1)
    if not away.max() <= POSITION_TOLERANCE_M:
        return (
            f"would be {away.max():.2g} m off its plan at {times[away.argmax()]:.3f} s, in the device's single precision;"
            f" {POSITION_TOLERANCE_M:g} m is allowed; use shorter pieces, or a frame with its origin nearer by"
        )
    return ""


def _name_misfit(drone: str) -> str:
    if ROS_NAME.fullmatch(drone):
        return ""
    return "has an id that ROS 2 does not take for a name; use letters, digits and underscores, a letter first"


def _fleet(places: Mapping[str, FloatArray | None]) -> str:
    """The YAML that lists the fleet; a drone whose place is not known is listed and switched off."""
    robots: dict[str, dict[str, Any]] = {}
    for number, (drone, place) in enumerate(places.items(), start=1):
        uri = f"radio://0/80/2M/{BASE_ADDRESS + number:X}"
        robots[drone] = {"enabled": place is not None, "uri": uri}
        if place is not None:
            robots[drone]["initial_position"] = [float(value) for value in place]
        robots[drone]["type"] = ROBOT_TYPE
    motion_capture = {"tracking": "librigidbodytracker", "marker": "default_single_marker", "dynamics": "default"}
    battery = {"voltage_warning": 3.8, "voltage_critical": 3.7}
    fleet = {
        "fileversion": 3,
        "robots": robots,
        "robot_types": {ROBOT_TYPE: {"motion_capture": motion_capture, "big_quad": False, "battery": battery}},
        "all": {
            "firmware_logging": {"enabled": False},
            "firmware_params": {
                "commander": {"enHighLevel": 1},
                "stabilizer": {"estimator": 2, "controller": 2},
                "locSrv": {"extPosStdDev": 1e-3, "extQuatStdDev": 0.05},
            },
            "broadcasts": {"num_repeats": 15, "delay_between_repeats_ms": 1},
        },
    }
    text: str = yaml().safe_dump(fleet, sort_keys=False, default_flow_style=None)
    return text


def yaml() -> Any:
    """PyYAML.

    Raises:
        MissingExtra: If it is not installed.
    """
    return require("yaml", extra="trajectory", package="PyYAML")
