"""Draws how the allocators learned: ``python docs/draw_learning_curves.py runs/teacher docs/images/learning-curves.png``.

The first argument is a folder of training runs called ``METHOD-SEED``, as `learned.teacher.train` leaves them.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flockopt.outputs.pictures.style import drone_color

#: What each method's excess is measured against.
REFERENCES = {"teacher": "best known travel", "magnnet": "optimal one-task assignment"}


def draw(runs: str, path: str) -> None:
    """Excess cost of the likeliest decisions on the validation scenes, a line a seed, a panel a method."""
    figure = Figure(figsize=(9.0, 3.4), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    for axes, method in zip(figure.subplots(1, 2), REFERENCES, strict=True):
        for index, run in enumerate(sorted(Path(runs).glob(f"{method}-*"))):
            draw_run(axes, run, index)
        axes.set(title=method, xlabel="iterations", ylabel=f"% above the {REFERENCES[method]}", ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


def draw_run(axes: Axes, run: Path, index: int) -> None:
    """One line, with the figure it ends at; the first measurements, off the scale, are cut off."""
    rows = [json.loads(line) for line in (run / "history.jsonl").read_text(encoding="utf-8").splitlines()]
    points = [(row["iteration"], 100.0 * row["excess"]) for row in rows if "excess" in row and row["iteration"] > 10]
    label = f"seed {run.name.rpartition('-')[2]}: {points[-1][1]:.1f} %"
    axes.plot(*zip(*points, strict=True), color=drone_color(index), linewidth=1.4, label=label)


if __name__ == "__main__":
    draw(*sys.argv[1:])
