"""Draws the paper's comparison of flights, baseline above ours: ``python docs/draw_comparison.py docs/images/comparison.png``.

Among cylinders and in a partitioned corridor: MAGNNET + bundling along the paths of a 6-connected grid, and the hybrid planner.
"""

from __future__ import annotations

import sys

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flockopt import Scene, generate, plan
from flockopt.outputs.pictures.motion import sample_motion
from flockopt.outputs.pictures.top_view import draw_top_view

SCENES = {"forest": "among cylinders", "corridor": "partitioned corridor"}
PIPELINES = {"magnnet-bundling": ("MAGNNET + bundling, grid paths", "voxel6"), "hybrid": ("hybrid", "any-angle")}

#: Drones and tasks: fewer than in the tables, so that single routes can be followed by eye.
DRONES, TASKS, SEED = 6, 14, 4


def draw(path: str) -> None:
    """The same two scenes, planned by both, seen from above."""
    figure = Figure(figsize=(11.0, 10.2), facecolor="white")
    FigureCanvasAgg(figure)
    scenes = {title: generate(family, drones=DRONES, tasks=TASKS, seed=SEED) for family, title in SCENES.items()}
    for row, planner in enumerate(PIPELINES):
        for column, (title, scene) in enumerate(scenes.items()):
            axes = figure.add_axes((0.02 + 0.5 * column, 0.015 + 0.5 * (1 - row), 0.46, 0.44))
            _draw_plan(axes, scene, title, planner)
    figure.savefig(path, dpi=110)


def _draw_plan(axes: Axes, scene: Scene, title: str, planner: str) -> None:
    words, paths = PIPELINES[planner]
    made = plan(scene, planner=planner, paths=paths)
    draw_top_view(axes, scene, made, sample_motion(scene, made), labelled=False)
    axes.set_xticks([])
    axes.set_yticks([])
    figures = f"{made.cost.length:.0f} m flown in {made.cost.makespan:.1f} s, {made.status}"
    axes.set_title(f"{title}: {words}\n{figures}", fontsize=11)


if __name__ == "__main__":
    draw(*sys.argv[1:])
