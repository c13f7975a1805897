"""Whether a place is walled in, with proof: a grid whose closed cells are closed for certain.

The distance to an obstacle changes by no more than one moves. So where a cell's centre is nearer to one than a drone's centre
may come, by more than half the cell's diagonal, no point of the cell is free. A way runs through cells that are not closed like
that, from neighbour to neighbour, corners included: where these do not connect two places, there is no way. Where they do there
may be one, or the grid is too coarse to tell.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from flockopt.geometry.distances import bounding_boxes, distances
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.scene.scene import POSITION_TOLERANCE_M

__all__ = ["Enclosure"]

#: Cells of the grids, the coarsest first: each is tried only where the one before cannot tell.
NUM_CELLS = (30_000, 300_000, 3_000_000)


class Enclosure:
    """The free space of drones of one radius, as far as grids can tell.

    Args:
        scene: Its obstacles, bounds and clearance count.
        radius: Of the drones, metres.
    """

    def __init__(self, scene: Scene, radius: float) -> None:
        self._table = scene.obstacle_table
        self._need = radius + scene.clearance - POSITION_TOLERANCE_M
        self._lower, self._upper = np.array(scene.bounds.lower), np.array(scene.bounds.upper)
        self._rooms = cache(self._room_numbers)

    def keeps_apart(self, origin: FloatArray, target: FloatArray) -> bool:
        """Whether it is proven that no way leads from one place (3,) to another."""
        places = np.array([origin, target])
        if len(self._table) == 0:
            return False
        if (distances(self._table, places) < self._need).any():
            return True
        return any(self._tell_apart(places, count) for count in NUM_CELLS)

    def _tell_apart(self, places: FloatArray, count: int) -> bool:
        rooms, size = self._rooms(count)
        cells = np.clip(((places - self._lower) / size).astype(int), 0, np.array(rooms.shape) - 1)
        here, there = (rooms[tuple(cell)] for cell in cells)
        return bool(here != there)

    def _room_numbers(self, count: int) -> tuple[NDArray[np.int32], FloatArray]:
        """For each cell of a grid of about so many the room that it is in, 0 where it is closed; and a cell's sides (3,) m."""
        from scipy.ndimage import label

        extent = np.maximum(self._upper - self._lower, 1e-9)
        side = float((extent.prod() / count) ** (1.0 / 3.0))
        while np.ceil(extent / side).prod() > 2 * count:  # a flat space takes fewer cells across
            side *= 1.2
        shape = np.ceil(extent / side).astype(int)
        size = extent / shape
        near = self._need - 0.5 * float(np.linalg.norm(size))
        is_open = np.ones(shape, dtype=np.bool_)
        for row, box in zip(self._table, bounding_boxes(self._table), strict=True):
            first = np.clip(np.floor((box[0] - max(near, 0.0) - self._lower) / size), 0, shape).astype(int)
            last = np.clip(np.ceil((box[1] + max(near, 0.0) - self._lower) / size), 0, shape).astype(int)
            axes = [self._lower[k] + (np.arange(first[k], last[k]) + 0.5) * size[k] for k in range(3)]
            centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
            gaps = distances(row[None], centres.reshape(-1, 3)).reshape(centres.shape[:3])
            is_open[first[0] : last[0], first[1] : last[1], first[2] : last[2]] &= gaps >= near
        rooms, _ = label(is_open, structure=np.ones((3, 3, 3)))
        return rooms, size
