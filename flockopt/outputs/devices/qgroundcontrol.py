"""Plans as missions for QGroundControl: a ``.plan`` file for each drone, with places in WGS 84.

A mission is a list of places and speeds, not a motion in time: the path is kept, to a named tolerance, and each leg's mean
speed; that drones keep apart is not. docs/export.md says what that means. The format is documented in QGroundControl's
developer guide ("Plan File Format"), the commands in MAVLink's ``MAV_CMD``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from flockopt.certificate import Plan
from flockopt.errors import SceneError
from flockopt.flights import Flight
from flockopt.outputs.devices.geodesy import geographic
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Origin, Point, Scene

__all__ = ["convert", "mission"]

#: MAVLink's MAV_CMD.
WAYPOINT, LOITER, LAND, TAKEOFF, CHANGE_SPEED = 16, 17, 21, 22, 178

#: MAVLink's MAV_FRAME: no place; latitude and longitude with the altitude above home.
FRAME_MISSION, FRAME_RELATIVE = 2, 3

#: MAV_AUTOPILOT_PX4, MAV_TYPE_QUADROTOR; QGroundControl's altitudes relative to home; DO_CHANGE_SPEED's ground speed.
PX4, QUADROTOR, RELATIVE_ALTITUDE, GROUND_SPEED = 12, 2, 1, 1

#: Straight lines between way points leave the curve by at most half the scene's clearance, within these limits.
FINEST_M, COARSEST_M = 0.02, 0.1

#: A waypoint counts as reached within the other half of the clearance, within these limits: 0 would leave it to the autopilot,
#: whose own radius may be ten metres.
NEAREST_M, FARTHEST_OFF_M = 0.1, 1.0

#: Between looks at the curve when way points are placed.
SAMPLE_S = 0.02

#: A drone that moves less than this rests; a rest shorter than this is none.
SMALLEST_MOVE_M, SHORTEST_HOLD_S = 1e-3, 1e-3

#: Speeds nearer to each other than this are the same.
SPEED_STEP_MPS = 0.01

#: A scene is a flat piece of ground around its origin: at this distance its plane is 800 m above the sea.
FARTHEST_M = 1e5

FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


def convert(plan: Plan, scene: Scene) -> tuple[dict[str, str], list[str]]:
    """Contents by file name, and what does not fit the device.

    Raises:
        SceneError: If the scene does not say where on Earth it is.
    """
    if scene.origin is None:
        mend = 'give latitude, longitude and altitude under "origin", and plan that scene'
        raise SceneError("origin", "is missing", "a mission needs places on Earth", mend)
    files, misfits = {}, []
    for drone in scene.drones:
        if drone.id not in plan.flights:
            continue
        if not FILE_NAME.fullmatch(drone.id):
            mend = "use letters, digits, dots, dashes and underscores"
            misfits.append(f"drone {drone.id} has an id that makes no file name; {mend}")
        if math.hypot(*drone.start) > FARTHEST_M:
            far = f"starts {math.hypot(*drone.start) / 1e3:.0f} km from the scene's (0, 0, 0), which its origin puts on Earth"
            mend = (
                f"places are within {FARTHEST_M / 1e3:g} km of it; subtract an offset from the scene, and give the origin there"
            )
            misfits.append(f"drone {drone.id} {far}; {mend}")
        files[f"{drone.id}.plan"] = json.dumps(mission(scene, scene.origin, drone, plan.flights[drone.id]), indent=4) + "\n"
    return files, misfits


def mission(scene: Scene, origin: Origin, drone: Drone, flight: Flight) -> dict[str, Any]:
    """The JSON object of a ``.plan`` file for one drone.

    Home is under its start, at height 0 of the scene. It takes off to its start, waits there if its flight begins late,
    visits its tasks, and at last lands at its ``end``, or hovers at the last place if it has none.
    """
    first = _point(flight.curve(flight.curve.start_time))
    last = _point(flight.curve(flight.curve.end_time))
    acceptance_m = min(max(scene.clearance / 2, NEAREST_M), FARTHEST_OFF_M)
    items = _Items(origin, geographic(origin, (first[0], first[1], 0.0)), acceptance_m)
    items.go(TAKEOFF, first)
    if flight.curve.start_time > 0.0:
        items.go(WAYPOINT, first, hold_s=flight.curve.start_time)
    for points, speed, hold_s in _legs(scene, flight):
        if speed is not None:
            items.set_speed(speed)
        for place in points[1:-1]:
            items.go(WAYPOINT, _point(place))
        items.go(WAYPOINT, _point(points[-1]), hold_s=hold_s)
    if drone.end_point is not None:
        items.go(LAND, (last[0], last[1], 0.0))
    else:
        items.go(LOITER, last)
    return {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "rallyPoints": {"points": [], "version": 2},
        "mission": {
            "version": 2,
            "firmwareType": PX4,
            "vehicleType": QUADROTOR,
            "globalPlanAltitudeMode": RELATIVE_ALTITUDE,
            "cruiseSpeed": drone.max_speed,
            "hoverSpeed": drone.max_speed,
            "plannedHomePosition": [round(items.home[0], 9), round(items.home[1], 9), round(items.home[2], 4)],
            "items": items.items,
        },
    }


class _Items:
    """A mission's items as they are added."""

    def __init__(self, origin: Origin, home: Point, acceptance_m: float) -> None:
        self.origin, self.home, self.acceptance_m = origin, home, acceptance_m
        self.items: list[dict[str, Any]] = []
        self._speed = 0.0

    def go(self, command: int, place: Point, hold_s: float = 0.0) -> None:
        """Go to a place; a waypoint's first parameters are the time to hold there, and within what it counts as reached."""
        latitude, longitude, altitude = geographic(self.origin, place)
        height = round(altitude - self.home[2], 4)
        where = [round(latitude, 9), round(longitude, 9), height]
        shown = {"AMSLAltAboveTerrain": None, "Altitude": height, "AltitudeMode": RELATIVE_ALTITUDE}
        radius_m = round(self.acceptance_m, 3) if command == WAYPOINT else 0
        self._add(command, FRAME_RELATIVE, [round(hold_s, 3), radius_m, 0, None, *where], shown)

    def set_speed(self, speed: float) -> None:
        """Fly at this speed, metres per second, from here on."""
        rounded = max(round(speed, 2), SPEED_STEP_MPS)
        if abs(rounded - self._speed) >= SPEED_STEP_MPS:
            self._speed = rounded
            self._add(CHANGE_SPEED, FRAME_MISSION, [GROUND_SPEED, rounded, -1, 0, 0, 0, 0], {})

    def _add(self, command: int, frame: int, params: list[float | None], shown: dict[str, Any]) -> None:
        number = {"doJumpId": len(self.items) + 1, "frame": frame, "params": params}
        self.items.append({"type": "SimpleItem", "autoContinue": True, "command": command, **number, **shown})


def _legs(scene: Scene, flight: Flight) -> Iterator[tuple[FloatArray, float | None, float]]:
    """Way points (W, 3) m of each stretch between visits, its mean speed (None at rest), how long to hold at its end."""
    from flockopt.geometry.polylines import thinned

    curve = flight.curve
    service = {task.id: task.service_time for task in scene.tasks}
    stops = [(visit.time, service.get(visit.task, 0.0)) for visit in flight.visits]
    tolerance_m = min(max(scene.clearance / 2, FINEST_M), COARSEST_M)
    begin = curve.start_time
    for time, hold_s in [*stops, (curve.end_time, 0.0)]:
        times = np.linspace(begin, max(time, begin), 2 + int(max(time - begin, 0.0) / SAMPLE_S))
        points = thinned(curve(times), tolerance_m)
        length = sum(float(np.linalg.norm(there - here)) for here, there in pairwise(points))
        if length > SMALLEST_MOVE_M:
            yield points, length / (time - begin), hold_s
        elif time - begin + hold_s > SHORTEST_HOLD_S:
            yield points[-2:], None, time - begin + hold_s
        begin = max(begin, time + hold_s)


def _point(values: FloatArray) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z
