"""Draws the scene families side by side: ``python docs/draw_families.py docs/images/families.png``."""

from __future__ import annotations

import sys

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flockopt.outputs.pictures.top_view import draw_top_view
from flockopt.scene.families.generate import generate
from flockopt.scene.families.layouts import FAMILIES


def draw(path: str) -> None:
    """Seed 0 of every family, 10 drones and 20 tasks, seen from above."""
    figure = Figure(figsize=(2.6 * len(FAMILIES), 2.95), facecolor="white")
    FigureCanvasAgg(figure)
    for column, family in enumerate(FAMILIES):
        axes = figure.add_axes(((column + 0.04) / len(FAMILIES), 0.03, 0.92 / len(FAMILIES), 0.84))
        scene = generate(family)
        draw_top_view(axes, scene, None, None, labelled=False)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_title(f"{family}  ({len(scene.obstacles)} obstacles)", fontsize=10)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    draw(*sys.argv[1:])
