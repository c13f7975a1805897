"""A flight as an animated GIF: drones and their trails on the map, tasks that fill with colour when they are served."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flockopt.errors import SettingsError, require
from flockopt.outputs.pictures.style import drone_color
from flockopt.outputs.pictures.top_view import draw_top_view
from flockopt.records import files
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from sim.mission.execute import Execution

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

__all__ = ["save_movie"]

FRAMES_PER_S, WIDTH_PIXELS, MOST_FRAMES = 12.5, 480, 250

#: Seconds of a drone's way that its trail shows.
TRAIL_S = 2.0

#: Everything is drawn this much larger and shrunk, which smooths edges.
OVERSAMPLING = 2

NUM_COLORS = 96


def save_movie(flight: Execution, path: Path) -> None:
    """Write a flight as a GIF, in real time unless it is long.

    Raises:
        MissingExtra: If matplotlib (and with it pillow) is not installed.
        SettingsError: If the file cannot be written.
    """
    target = files.check_output(SettingsError, path)
    ground, pixels = _ground(flight.scene)
    from PIL.Image import Dither

    last = float(flight.times[-1])
    num_frames = int(np.clip(last * FRAMES_PER_S, 2, MOST_FRAMES))
    pictures = [_frame(ground, pixels, flight, moment) for moment in np.linspace(0.0, last, num_frames)]
    palette = pictures[-1].quantize(NUM_COLORS)
    frames = [picture.quantize(palette=palette, dither=Dither.NONE) for picture in pictures]
    frames[0].save(target, format="GIF", save_all=True, append_images=frames[1:], duration=int(1000 / FRAMES_PER_S), loop=0)


class _Pixels:
    """From metres to pixels of the large picture."""

    def __init__(self, origin: FloatArray, scale: FloatArray) -> None:
        self.origin, self.scale = origin, scale

    def __call__(self, points: FloatArray) -> FloatArray:
        return self.origin + np.asarray(points)[..., :2] * self.scale


def _ground(scene: Scene) -> tuple[Image, _Pixels]:
    """The map without drones, and how to draw on it."""
    require("matplotlib", extra="show")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    lower, upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
    aspect = float((upper[1] - lower[1]) / (upper[0] - lower[0]))
    dpi = 100.0
    inches = WIDTH_PIXELS * OVERSAMPLING / dpi
    figure = Figure(figsize=(inches, max(inches * aspect, 0.1)), dpi=dpi)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_top_view(axes, scene, None, None, labelled=False)
    axes.axis("off")
    canvas.draw()
    corners = axes.transData.transform(np.array([[0.0, 0.0], [1.0, 1.0]]))
    height = figure.bbox.height
    origin = np.array([corners[0, 0], height - corners[0, 1]])
    scale = np.array([corners[1, 0] - corners[0, 0], corners[0, 1] - corners[1, 1]])
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    return picture, _Pixels(origin, scale)


def _frame(ground: Image, pixels: _Pixels, flight: Execution, moment: float) -> Image:
    from PIL.ImageColor import getrgb
    from PIL.ImageDraw import Draw

    picture = ground.copy()
    draw = Draw(picture)
    now = int(np.searchsorted(flight.times, moment, side="right")) - 1
    begin = int(np.searchsorted(flight.times, moment - TRAIL_S))
    stride = max(1, (now - begin) // 40)
    size = 5.0 * OVERSAMPLING
    places = {task.id: np.array(task.position) for task in flight.scene.tasks}
    for i, drone in enumerate(flight.scene.drones):
        color = getrgb(drone_color(i))
        made = flight.flights.get(drone.id)
        for visit in () if made is None else made.visits:
            if visit.time <= moment and visit.task in flight.measures.served:
                _disc(draw, pixels(places[visit.task]), 0.7 * size, color)
        if np.isnan(flight.positions[now, i]).any():  # it was lost
            continue
        trail = pixels(flight.positions[begin : now + 1 : stride, i])
        if len(trail) > 1:
            draw.line([tuple(point) for point in trail.tolist()], fill=color, width=2 * OVERSAMPLING)
        radius = max(size, float(abs(pixels.scale[0])) * drone.radius)
        _disc(draw, pixels(flight.positions[now, i]), radius, color)
    draw.text((8 * OVERSAMPLING, 6 * OVERSAMPLING), f"{moment:.1f} s", fill=(60, 60, 60), font_size=14 * OVERSAMPLING)
    return picture.resize((picture.width // OVERSAMPLING, picture.height // OVERSAMPLING))


def _disc(draw: ImageDraw, center: FloatArray, radius: float, color: tuple[int, ...]) -> None:
    x, y = center.tolist()
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color, outline=(255, 255, 255), width=OVERSAMPLING)
