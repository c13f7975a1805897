"""The picture's map: obstacles shaded by height, starts, tasks and routes, with labels kept apart."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from flockopt.outputs.pictures.motion import SampledMotion
from flockopt.outputs.pictures.style import INK, MUTED, drone_color, drone_round, extent_z, servers
from flockopt.records.arrays import FloatArray
from flockopt.scene import Box, Obstacle, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Patch

    from flockopt.certificate import Plan

__all__ = ["draw_top_view"]

#: Most drones and tasks that still get their names written.
MOST_DRONE_LABELS, MOST_TASK_LABELS = 30, 60

HANGING: dict[str, Any] = {"facecolor": (1, 1, 1, 0.35), "hatch": "////", "edgecolor": "#8a94a3", "linewidth": 0.5}

LABEL_POINTS = 7.0
#: Where a label may stand around its point, in order of preference: right first, then above, below, left.
LABEL_ANGLES = (0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)


def draw_top_view(axes: Axes, scene: Scene, plan: Plan | None, motion: SampledMotion | None, *, labelled: bool = True) -> None:
    """Draw the scene from above, north up, true to scale; with a motion, its routes too.

    Without labels there are no names, no key and no axis titles.
    """
    lower, upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    rim = 0.012 * float(max(upper[:2] - lower[:2]))
    axes.set_xlim(lower[0] - rim, upper[0] + rim)
    axes.set_ylim(lower[1] - rim, upper[1] + rim)
    axes.set_aspect("equal", adjustable="box")
    axes.tick_params(length=3, labelsize=8)
    axes.ticklabel_format(useOffset=False, style="plain")  # far from zero, coordinates are told whole
    _draw_obstacles(axes, scene)
    if motion is not None:
        _draw_routes(axes, motion)
    server = servers(scene, plan)
    _draw_points(axes, scene, plan, server)
    if labelled:
        axes.set_xlabel("x, m", labelpad=1)
        axes.set_ylabel("y, m", labelpad=1)
        _draw_key(axes, scene, has_unserved=plan is not None and len(server) < scene.num_tasks)
        _draw_labels(axes, scene, motion, server)


def _draw_obstacles(axes: Axes, scene: Scene) -> None:
    """Lowest first; what hangs above the floor is hatched and lets show what is below it."""
    low, high = scene.bounds.lower[2], _highest(scene)
    for obstacle in sorted(scene.obstacles, key=lambda obstacle: extent_z(obstacle)[1]):
        top = min(extent_z(obstacle)[1], high)
        look = HANGING if _hangs(scene, obstacle) else _standing((top - low) / max(high - low, 1e-9))
        axes.add_patch(_footprint(obstacle, look))


def _highest(scene: Scene) -> float:
    """Where the tallest obstacle ends within the bounds."""
    tops = [extent_z(obstacle)[1] for obstacle in scene.obstacles]
    return min(max(tops, default=0.0), scene.bounds.upper[2])


def _hangs(scene: Scene, obstacle: Obstacle) -> bool:
    low, high = scene.bounds.lower[2], scene.bounds.upper[2]
    return extent_z(obstacle)[0] > low + 0.02 * (high - low)


def _standing(share: float) -> dict[str, Any]:
    """How an obstacle looks that reaches this share of the height of the tallest."""
    shade = 0.93 - 0.42 * max(share, 0.0)
    return {"facecolor": (shade, shade + 0.005, shade + 0.02), "edgecolor": "#7c8696", "linewidth": 0.6}


def _footprint(obstacle: Obstacle, look: dict[str, Any]) -> Patch:
    from matplotlib.patches import Circle, Polygon

    x, y, _ = obstacle.center
    if not isinstance(obstacle, Box):
        return Circle((x, y), obstacle.radius, zorder=1, **look)
    cos, sin = math.cos(obstacle.yaw), math.sin(obstacle.yaw)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(obstacle.size[:2]) / 2
    return Polygon(corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y), closed=True, zorder=1, **look)


def _draw_routes(axes: Axes, motion: SampledMotion) -> None:
    from matplotlib.patheffects import Normal, Stroke

    width = float(np.interp(len(motion.positions), [10, 100], [1.7, 0.8]))
    halo = [Stroke(linewidth=width + 1.6, foreground="white"), Normal()]
    for index, path in enumerate(motion.positions):
        dashes: Any = "-" if drone_round(index) == 0 else (0, (5, 1.5)) if drone_round(index) == 1 else (0, (1.5, 1))
        look = {"color": drone_color(index), "linewidth": width, "linestyle": dashes, "path_effects": halo}
        axes.plot(path[:, 0], path[:, 1], zorder=3, solid_capstyle="round", **look)


def _draw_points(axes: Axes, scene: Scene, plan: Plan | None, server: dict[str, int]) -> None:
    size = float(np.interp(scene.num_tasks, [40, 400], [5.2, 2.4]))
    for task in scene.tasks:
        x, y, _ = task.position
        if plan is not None and task.id not in server:
            axes.plot(x, y, "x", color=INK, markersize=size + 1, markeredgewidth=1.6, zorder=5)
        else:
            color = drone_color(server[task.id]) if plan is not None else INK
            axes.plot(x, y, "o", color="white", markeredgecolor=color, markersize=size, markeredgewidth=1.5, zorder=5)
    size = float(np.interp(scene.num_drones, [20, 200], [7.5, 4.0]))
    for index, (x, y, _) in enumerate(scene.starts):
        axes.plot(x, y, "^", color=drone_color(index), markersize=size, markeredgecolor="white", markeredgewidth=0.9, zorder=6)


def _draw_key(axes: Axes, scene: Scene, *, has_unserved: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marks: list[Any] = [
        Line2D([], [], marker="^", color=MUTED, linestyle="none", markersize=7, label="start"),
        Line2D([], [], marker="o", color="white", markeredgecolor=MUTED, markeredgewidth=1.5, linestyle="none", label="task"),
    ]
    if has_unserved:
        marks.append(Line2D([], [], marker="x", color=INK, markeredgewidth=1.6, linestyle="none", label="unserved task"))
    tops = [extent_z(obstacle)[1] for obstacle in scene.obstacles if not _hangs(scene, obstacle)]
    if tops and min(tops) < 0.98 * _highest(scene):
        marks.append(Patch(**_standing(min(tops) / _highest(scene)), label=f"{min(tops):.2g} m high"))
    if tops:
        marks.append(Patch(**_standing(1.0), label=f"{_highest(scene):.2g} m high"))
    if any(_hangs(scene, obstacle) for obstacle in scene.obstacles):
        marks.append(Patch(**HANGING, label="hangs: fly under"))
    below = -0.52 / (axes.figure.get_figheight() * axes.get_position().height)  # type: ignore[union-attr]
    axes.legend(
        handles=marks, loc="upper left", bbox_to_anchor=(0.0, below), ncols=len(marks), frameon=False, fontsize=8,
        borderaxespad=0, handletextpad=0.5, columnspacing=1.3, labelcolor=MUTED,
    )  # fmt: skip


def _draw_labels(axes: Axes, scene: Scene, motion: SampledMotion | None, server: dict[str, int]) -> None:
    """Names beside starts and tasks, each where it covers least of markers, routes and other names."""
    from matplotlib.patheffects import withStroke

    names: list[tuple[str, FloatArray, str, bool]] = []
    if scene.num_drones <= MOST_DRONE_LABELS:
        names += [(drone.id, scene.starts[i, :2], drone_color(i), True) for i, drone in enumerate(scene.drones)]
    if scene.num_tasks <= MOST_TASK_LABELS:
        names += [
            (task.id, np.array(task.position[:2]), drone_color(server[task.id]) if task.id in server else MUTED, False)
            for task in scene.tasks
        ]
    to_points = axes.transData.transform
    per_point = axes.figure.dpi / 72.0
    markers = to_points(np.concatenate([scene.starts[:, :2], scene.task_positions[:, :2]])) / per_point
    ways = np.empty((0, 2)) if motion is None else to_points(motion.positions[:, ::3, :2].reshape(-1, 2)) / per_point
    frame = axes.get_window_extent().get_points() / per_point
    taken = np.empty((0, 4))
    for name, place, color, is_drone in names:
        half = np.array([0.31 * LABEL_POINTS * len(name) * (1.08 if is_drone else 1.0), 0.5 * LABEL_POINTS])
        center = _best_place(to_points(place) / per_point, half, markers, ways, taken, frame)
        taken = np.vstack([taken, [*(center - half), *(center + half)]])
        x, y = axes.transData.inverted().transform(center * per_point)
        weight = "bold" if is_drone else "normal"
        halo = [withStroke(linewidth=1.8, foreground="white")]
        look: dict[str, Any] = {"fontsize": LABEL_POINTS, "color": color, "fontweight": weight, "path_effects": halo}
        axes.text(x, y, name, ha="center", va="center_baseline", zorder=7, **look)


def _best_place(
    anchor: FloatArray, half: FloatArray, markers: FloatArray, ways: FloatArray, taken: FloatArray, frame: FloatArray
) -> FloatArray:
    """The centre, in points, among a ring of candidates, whose label covers least."""
    best, least = anchor, math.inf
    for rank, angle in enumerate(np.deg2rad(LABEL_ANGLES)):
        direction = np.array([math.cos(angle), math.sin(angle)])
        center = anchor + direction * (half + 4.5)
        names = ((taken[:, :2] < center + half) & (taken[:, 2:] > center - half)).all(axis=1).sum()
        outside = (center - half < frame[0]).any() or (center + half > frame[1]).any()
        marks = (np.abs(markers - center) < half + 3.0).all(axis=1).sum()
        crossed = (np.abs(ways - center) < half).all(axis=1).sum()
        cost = 20.0 * (names + outside) + 8.0 * marks + min(crossed, 12) * 0.5 + 0.1 * rank
        if cost < least:
            best, least = center, cost
    return best
