"""The HTML page: one file that plays the flight from the plan's own polynomials, with no network and no server."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from flockopt.certificate.placement import plan_into
from flockopt.flights import Flight
from flockopt.outputs.pictures.motion import SampledMotion, flights_of, sample_motion
from flockopt.outputs.pictures.style import INK, MUTED, drone_color, extent_z, headline, servers
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone, Scene
from flockopt.scene.frame import Frame

if TYPE_CHECKING:
    from flockopt.certificate import Plan

__all__ = ["page"]

#: Which file goes where in the template.
CODE = {"__VIEW__": "view.js", "__PLAYER__": "player.js"}


def page(scene: Scene, plan: Plan | None = None) -> str:
    """The page's content: template, view, player and the flight's data in one text.

    It is drawn in the frame around the scene's midst: browsers draw in single precision, and no coordinates are shown.
    """
    frame = Frame.of(scene.bounds)
    scene, plan = frame.near(scene), None if plan is None else plan_into(frame, plan)
    parts = files("flockopt.outputs.pictures")
    text = (parts / "page.html").read_text(encoding="utf-8")
    flight = json.dumps(_flight(scene, plan), separators=(",", ":"), allow_nan=False)
    pieces = {mark: (parts / name).read_text(encoding="utf-8") for mark, name in CODE.items()}
    # Names come from strangers' files: a "<" must not end the script element that the data stands in, and since the
    # data goes in last, what looks like a mark in it stays as it is.
    pieces["__FLIGHT__"] = flight.replace("<", "\\u003c")
    for mark, content in pieces.items():
        head, tail = text.split(mark, 1)
        text = head + content + tail
    return text


def _flight(scene: Scene, plan: Plan | None) -> dict[str, Any]:
    motion, flights = sample_motion(scene, plan), flights_of(scene, plan)
    return {
        "name": scene.name,
        "facts": headline(scene, plan),
        "bounds": {"lower": scene.bounds.lower, "upper": scene.bounds.upper},
        "clearance": scene.clearance,
        "separation": float(scene.widest_axes[0]),
        "makespan": max((flight.curve.end_time for flight in flights.values()), default=0.0),
        "drones": [_drone(index, drone, plan, flights.get(index)) for index, drone in enumerate(scene.drones)],
        "tasks": _tasks(scene, plan),
        "obstacles": [_obstacle(record, scene, index) for index, record in enumerate(scene.to_dict()["obstacles"])],
        "series": None if motion is None else _series(motion),
    }


def _drone(index: int, drone: Drone, plan: Plan | None, flight: Flight | None) -> dict[str, Any]:
    return {
        "id": drone.id,
        "start": drone.start,
        "radius": drone.radius,
        "color": drone_color(index),
        "tasks": [] if plan is None else list(plan.routes.get(drone.id, ())),
        "length": None if flight is None else round(flight.curve.length, 3),
        "breakpoints": [] if flight is None else flight.curve.breakpoints.tolist(),
        "coefficients": [] if flight is None else _short(flight.curve.coefficients),
    }


def _short(values: FloatArray) -> Any:
    """Nested lists of nine digits: far below what a pixel shows."""
    shortened = [float(f"{value:.9g}") for value in values.ravel()]
    return np.array(shortened).reshape(values.shape).tolist()


def _tasks(scene: Scene, plan: Plan | None) -> list[dict[str, Any]]:
    """Each task with its drone's colour and the time of its visit, if it has one."""
    colors = {task: drone_color(drone) for task, drone in servers(scene, plan).items()}
    times = {visit.task: visit.time for flight in flights_of(scene, plan).values() for visit in flight.visits}
    without = INK if plan is None else MUTED
    return [
        {"id": task.id, "position": task.position, "color": colors.get(task.id, without), "time": times.get(task.id)}
        for task in scene.tasks
    ]


def _obstacle(record: dict[str, Any], scene: Scene, index: int) -> dict[str, Any]:
    bottom, top = extent_z(scene.obstacles[index])
    return {**record, "bottom": bottom, "top": top}


def _series(motion: SampledMotion) -> dict[str, Any]:
    """Least distances over time; None where there is nothing to be near to."""

    def shown(values: FloatArray) -> list[float] | None:
        return np.round(values, 4).tolist() if np.isfinite(values).all() else None

    times = np.round(motion.times, 4).tolist()
    return {"times": times, "separation": shown(motion.separation), "clearance": shown(motion.clearance)}
