"""A frame in which a scene is near zero, wherever its own coordinates put it.

Floating point tells places 1e-16 of their size apart: at 5e6 m, where UTM coordinates lie, distances, their squares and the
polynomials of flights lose what the judge's tolerances need. So fleets are planned and judged in a frame whose origin is in
their midst, and what comes of it is written in the scene's own coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flockopt.records.arrays import FloatArray
from flockopt.scene.parts import Bounds, Drone, Obstacle, Point
from flockopt.scene.scene import Scene

__all__ = ["Frame"]

#: Scenes whose middle is this near to zero stay as they are, along each axis: a square of it still tells micrometres apart.
NEAR_M = 1e4


@dataclass(frozen=True)
class Frame:
    """Coordinates that begin at ``offset``.

    Offsets are whole metres, so that it is exact to subtract them from the coordinates of a scene.

    Attributes:
        offset: Where this frame's zero is in the scene's own coordinates, metres.
    """

    offset: Point

    @classmethod
    def of(cls, bounds: Bounds) -> Frame:
        """The frame around the middle of these bounds; the scene's own along each axis on which that is near zero."""
        x, y, z = (_offset(low, high) for low, high in zip(bounds.lower, bounds.upper, strict=True))
        return cls((x, y, z))

    @property
    def is_own(self) -> bool:
        """Whether it is the scene's own."""
        return not any(self.offset)

    @property
    def vector(self) -> FloatArray:
        """The offset, (3,) m."""
        return np.array(self.offset)

    def near(self, scene: Scene) -> Scene:
        """The scene in this frame, without its origin on Earth; itself where the frame is its own."""
        return scene if self.is_own else _moved(scene, self.into)

    def into(self, point: Point) -> Point:
        """A point of the scene in this frame."""
        x, y, z = (value - shift for value, shift in zip(point, self.offset, strict=True))
        return x, y, z

    def out_of(self, point: Point) -> Point:
        """A point of this frame in the scene's own coordinates."""
        x, y, z = (value + shift for value, shift in zip(point, self.offset, strict=True))
        return x, y, z


def _offset(low: float, high: float) -> float:
    middle = low + (high - low) / 2.0
    return float(round(middle)) if abs(middle) > NEAR_M else 0.0


def _moved(scene: Scene, move: Callable[[Point], Point]) -> Scene:
    def drone(record: Drone) -> Drone:
        end = move(record.end) if isinstance(record.end, tuple) else record.end
        return replace(record, start=move(record.start), end=end)

    def obstacle(record: Obstacle) -> Obstacle:
        return replace(record, center=move(record.center))

    return scene.replace(
        bounds=Bounds(move(scene.bounds.lower), move(scene.bounds.upper)),
        drones=tuple(drone(record) for record in scene.drones),
        tasks=tuple(replace(task, position=move(task.position)) for task in scene.tasks),
        obstacles=tuple(obstacle(record) for record in scene.obstacles),
        origin=None,
    )
