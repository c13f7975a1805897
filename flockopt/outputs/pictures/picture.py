"""The PNG: a top view, and the plan's altitude, least separation and least clearance over time."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from flockopt.errors import require
from flockopt.outputs.pictures.motion import SampledMotion, sample_motion
from flockopt.outputs.pictures.style import DANGER, INK, MUTED, drone_color, drone_round, headline
from flockopt.outputs.pictures.top_view import draw_top_view
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flockopt.certificate import Plan

__all__ = ["picture"]

#: Dots per inch, and the sizes that the layout is made of, inches.
DPI = 144
MAP_WIDEST_IN, MAP_TALLEST_IN, MAP_SMALLEST_IN = 9.0, 6.4, 3.4
LEFT_IN, BOTTOM_IN, TOP_IN, RIGHT_IN, BETWEEN_IN, PANEL_WIDTH_IN, PANEL_GAP_IN = 0.6, 0.9, 0.85, 0.35, 0.85, 4.9, 0.42

STYLE: Any = {
    "font.family": "DejaVu Sans", "font.size": 9, "axes.edgecolor": "#aab2bd", "axes.linewidth": 0.8,
    "axes.labelcolor": MUTED, "xtick.color": MUTED, "ytick.color": MUTED, "text.color": INK, "hatch.linewidth": 0.7,
    "text.parse_math": False, "savefig.facecolor": "white", "figure.facecolor": "white",
}  # fmt: skip


def picture(scene: Scene, plan: Plan | None = None) -> bytes:
    """The PNG file's content.

    Raises:
        MissingExtra: If matplotlib is not installed.
    """
    require("matplotlib", extra="show")
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    motion = sample_motion(scene, plan)
    with matplotlib.rc_context(), warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes, and that is all there is to say about it.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        matplotlib.rcdefaults()  # a user's own style would break the layout
        matplotlib.rcParams.update(STYLE)
        figure = Figure()
        FigureCanvasAgg(figure)
        _compose(figure, scene, plan, motion)
        content = io.BytesIO()
        # Without the metadata the same plan gives the same bytes under any version of matplotlib's name.
        figure.savefig(content, format="png", dpi=DPI, metadata={"Software": None})
    return content.getvalue()


def _compose(figure: Figure, scene: Scene, plan: Plan | None, motion: SampledMotion | None) -> None:
    map_width, map_height = _map_size(scene)
    panels = BETWEEN_IN + PANEL_WIDTH_IN if motion is not None else 0.0
    width = max(LEFT_IN + map_width + panels + RIGHT_IN, 6.4)
    area_height = max(map_height, 4.6 if motion is not None else 0.0)
    height = BOTTOM_IN + area_height + TOP_IN
    figure.set_size_inches(width, height)

    def axes(left: float, bottom: float, wide: float, high: float) -> Axes:
        return figure.add_axes((left / width, bottom / height, wide / width, high / height))

    lift = (area_height - map_height) / 2
    draw_top_view(axes(LEFT_IN, BOTTOM_IN + lift, map_width, map_height), scene, plan, motion)
    left, facts = LEFT_IN / width, "  ·  ".join(headline(scene, plan))
    figure.text(left, 1 - 0.36 / height, _fitting(scene.name, 6.5 * width), fontsize=15, fontweight="bold", va="center")
    figure.text(left, 1 - 0.64 / height, _fitting(facts, 11 * width), fontsize=10, color=MUTED, va="center")
    if motion is None:
        return
    left = LEFT_IN + map_width + BETWEEN_IN
    high = (area_height - 2 * PANEL_GAP_IN) / 3
    stack = [axes(left, BOTTOM_IN + row * (high + PANEL_GAP_IN), PANEL_WIDTH_IN, high) for row in (2, 1, 0)]
    _draw_altitude(stack[0], scene, motion)
    _draw_least(stack[1], motion.times, motion.separation, float(scene.widest_axes[0]), "least separation", "only one drone")
    _draw_least(stack[2], motion.times, motion.clearance, scene.clearance, "least clearance", "no obstacles")
    for panel in stack[:2]:
        panel.tick_params(labelbottom=False)
    stack[2].set_xlabel("time, s")


def _fitting(words: str, num_letters: float) -> str:
    """One line of at most that many letters."""
    line, most = " ".join(words.split()), int(num_letters)
    return line if len(line) <= most else f"{line[: most - 1]}…"


def _map_size(scene: Scene) -> tuple[float, float]:
    """Inches that show the bounds true to scale."""
    length, width, _ = np.subtract(scene.bounds.upper, scene.bounds.lower)
    scale = min(MAP_WIDEST_IN / length, MAP_TALLEST_IN / width)
    return max(MAP_SMALLEST_IN, scale * length), max(MAP_SMALLEST_IN, scale * width)


def _prepare(panel: Axes, motion_times: FloatArray, title: str) -> None:
    panel.set_title(title, loc="left", fontsize=9.5, color=INK, fontweight="bold", pad=5)
    panel.set_xlim(0.0, float(motion_times[-1]))
    panel.grid(color="#e6e9ee", linewidth=0.7)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(length=3, labelsize=8)


def _draw_altitude(panel: Axes, scene: Scene, motion: SampledMotion) -> None:
    _prepare(panel, motion.times, "altitude, m")
    for index, path in enumerate(motion.positions):
        dashes: Any = "-" if drone_round(index) == 0 else "--" if drone_round(index) == 1 else ":"
        panel.plot(motion.times, path[:, 2], color=drone_color(index), linestyle=dashes, linewidth=1.2)
    low, high = scene.bounds.lower[2], float(motion.positions[:, :, 2].max())
    panel.set_ylim(low, low + 1.12 * (high - low) + 1e-3)


def _draw_least(panel: Axes, times: FloatArray, least: FloatArray, required: float, title: str, nothing: str) -> None:
    """A least distance over time, what is required of it, and where it comes nearest to that."""
    _prepare(panel, times, f"{title}, m")
    if not np.isfinite(least).all():
        panel.text(0.5, 0.5, nothing, transform=panel.transAxes, ha="center", va="center", color=MUTED)
        panel.set_yticks([])
        return
    worst = int(np.argmin(least))
    top = 1.15 * max(float(least.max()), 2 * required, 1e-3)
    bottom = min(0.0, 1.1 * float(least.min()))
    panel.set_ylim(bottom, top)
    panel.plot(times, least, color=INK, linewidth=1.3)
    if required > 0.0:
        panel.axhspan(bottom, required, color=DANGER, alpha=0.08, linewidth=0)
        panel.axhline(required, color=DANGER, linewidth=1.1, linestyle=(0, (4, 2)))
    panel.plot(times[worst], least[worst], "o", color=INK, markersize=4.5, markeredgecolor="white", zorder=5, clip_on=False)
    words = f"least {least[worst]:.2f} at {times[worst]:.1f} s"
    if required > 0.0:
        words += f", required {required:.2g}"
    panel.set_title(words, loc="right", fontsize=8.5, color=MUTED, pad=5)
