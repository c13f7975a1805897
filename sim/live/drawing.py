"""The fleet in 3-D on a live page: obstacles, drones with trails and ways ahead, tasks by state."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flockopt.outputs.pictures.style import drone_color
from flockopt.records.arrays import FloatArray
from flockopt.scene import Box, Cylinder, Scene
from sim.live.view import TaskView, View

if TYPE_CHECKING:
    import viser

__all__ = ["FleetDrawing"]

GREY, DARK, WHITE = (158, 166, 178), (60, 66, 76), (255, 255, 255)

#: Seconds of a drone's way that its trail shows.
TRAIL_S = 3.0

#: Least size of what is drawn, as a share of the scene's diagonal, so that small drones are seen in large scenes.
LEAST_SIZE = 0.008

#: How thick lines are, in that size: trails, ways ahead, the edges of the bounds.
TRAIL, WAY, EDGE = 0.5, 0.25, 0.1


class FleetDrawing:
    """What a page shows of a scene and of what moves in it.

    Args:
        server: The page.
        scene: The scene as it was at first.
    """

    def __init__(self, server: viser.ViserServer, scene: Scene) -> None:
        lower, upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
        self._draw, self._size = server.scene, LEAST_SIZE * float(np.linalg.norm(upper - lower))
        self._colors = {drone.id: _rgb(drone_color(index)) for index, drone in enumerate(scene.drones)}
        self._trails: dict[str, deque[tuple[float, FloatArray]]] = {drone.id: deque() for drone in scene.drones}
        self._tasks: dict[str, tuple[TaskView, Any]] = {}
        self._look(server, lower, upper)
        self._draw_space(lower, upper)
        self._draw_obstacles(scene)
        self._drones = {drone.id: self._drone(index, drone.id, drone.radius) for index, drone in enumerate(scene.drones)}

    def show(self, view: View) -> None:
        """Move what moves, and draw tasks anew whose state has changed."""
        for drone, handle in self._drones.items():
            if drone in view.drones:
                handle.position = view.drones[drone]
            elif not handle.wireframe:
                handle.color, handle.wireframe = DARK, True
        self._draw_trails(view)
        for task in view.tasks:
            if task.id not in self._tasks or self._tasks[task.id][0] != task:
                self._draw_task(task)
        for name in self._tasks.keys() - {task.id for task in view.tasks}:
            self._tasks.pop(name)[1].remove()

    def show_ways(self, ways: Mapping[str, FloatArray]) -> None:
        """Draw what drones have ahead of them, (V, 3) m by id."""
        faint = {drone: (np.array(color) + np.array(WHITE)) // 2 for drone, color in self._colors.items()}
        self._draw_lines("/ways", ways, faint, WAY)

    def _look(self, server: viser.ViserServer, lower: FloatArray, upper: FloatArray) -> None:
        """Let the camera begin in the south, above the scene."""
        middle, reach = (lower + upper) / 2, float(np.linalg.norm(upper - lower))
        server.scene.set_up_direction("+z")
        server.initial_camera.position = tuple(middle + reach * np.array([-0.1, -0.58, 0.46]))
        server.initial_camera.look_at = tuple(middle)
        server.initial_camera.far = max(1000.0, 10.0 * reach)

    def _draw_space(self, lower: FloatArray, upper: FloatArray) -> None:
        """A grid on the floor and the edges of the bounds."""
        length, width, _ = (upper - lower).tolist()
        x, y, _ = ((lower + upper) / 2).tolist()
        cell = 10.0 ** math.floor(math.log10(max(length, width) / 5.0))
        self._draw.add_grid("/floor", length, width, cell_size=cell, section_size=5.0 * cell, position=(x, y, float(lower[2])))
        corners = [np.where(np.array(bits) == 1, upper, lower) for bits in product((0, 1), repeat=3)]
        edges = np.array([(a, b) for a, b in combinations(corners, 2) if np.count_nonzero(a != b) == 1])  # (12, 2, 3)
        self._draw.add_line_segments("/bounds", edges, GREY, thickness=EDGE * self._size)

    def _draw_obstacles(self, scene: Scene) -> None:
        for number, obstacle in enumerate(scene.obstacles):
            name = f"/obstacles/{number}"
            if isinstance(obstacle, Box):
                turn = (math.cos(obstacle.yaw / 2), 0.0, 0.0, math.sin(obstacle.yaw / 2))
                self._draw.add_box(name, GREY, obstacle.size, wxyz=turn, position=obstacle.center)
            elif isinstance(obstacle, Cylinder):
                self._draw.add_cylinder(name, obstacle.radius, obstacle.height, GREY, position=obstacle.center)
            else:
                self._draw.add_icosphere(name, obstacle.radius, GREY, position=obstacle.center)

    def _drone(self, index: int, name: str, radius: float) -> Any:
        size = max(radius, self._size)
        handle = self._draw.add_icosphere(f"/drones/{index}", size, self._colors[name])
        self._draw.add_label(f"/drones/{index}/name", name, position=(0.0, 0.0, 1.6 * size))
        return handle

    def _draw_trails(self, view: View) -> None:
        for drone, trail in self._trails.items():
            if drone in view.drones and (not trail or view.now_s > trail[-1][0]):
                trail.append((view.now_s, view.drones[drone]))
            while trail and trail[0][0] < view.now_s - TRAIL_S:
                trail.popleft()
        points = {drone: np.array([place for _, place in trail]).reshape(-1, 3) for drone, trail in self._trails.items()}
        self._draw_lines("/trails", points, self._colors, TRAIL)

    def _draw_lines(self, name: str, lines: Mapping[str, FloatArray], colors: Mapping[str, Any], thickness: float) -> None:
        """Draw polylines (V, 3) by drone, all in one go."""
        segments, shades = [np.empty((0, 2, 3))], list[NDArray[np.uint8]]()
        for drone, points in lines.items():
            segments.append(np.stack([points[:-1], points[1:]], axis=1))
            shades.append(np.full((len(segments[-1]), 2, 3), colors[drone], dtype=np.uint8))
        together = np.concatenate(segments)
        if len(together):
            self._draw.add_line_segments(name, together, np.concatenate(shades), thickness=thickness * self._size)
        else:
            self._draw.remove_by_name(name)

    def _draw_task(self, task: TaskView) -> None:
        """A ball in its drone's colour; small and grey once it is served, a net where it is left out."""
        if task.id in self._tasks:
            self._tasks[task.id][1].remove()
        is_served = task.state == "served"
        size, color = self._size * (0.5 if is_served else 1.0), self._colors.get(task.drone or "", GREY if is_served else DARK)
        name = f"/tasks/{task.id.replace('/', '_')}"
        ball = self._draw.add_icosphere(name, size, color, wireframe=task.state == "left out", position=task.position)
        if not is_served:
            words = task.id if task.state == "open" else f"{task.id} {task.state}"
            self._draw.add_label(f"{name}/name", words, position=(0.0, 0.0, 1.6 * size))
        self._tasks[task.id] = (task, ball)


def _rgb(color: str) -> tuple[int, int, int]:
    """From ``#rrggbb``."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
