"""Fewer boxes that fill the same space: what came as voxels is planned as walls and blocks.

Boxes of one yaw that lie side by side, with equal faces there, fill one box together, so no distance to their union changes.
Rows grow along one axis, rows of equal ends into slabs, slabs into blocks, until nothing joins any more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SceneError
from flockopt.records.arrays import FloatArray
from flockopt.scene.parts import Box, Obstacle
from flockopt.scene.scene import Scene

__all__ = ["merged_obstacles", "with_merged_obstacles"]

#: Faces this near to each other are one, metres: what is left of decimal numbers far from zero.
SAME_FACE_M = 1e-8

#: Boxes are joined where at most this share of the obstacles is left: for a few fewer it is not worth the while, and a way
#: around one box may differ by rounding from the way around its halves.
WORTH_SHARE = 0.5


def with_merged_obstacles(scene: Scene) -> Scene:
    """The scene with fewer boxes that fill the same space; itself where that saves little."""
    obstacles = merged_obstacles(scene.obstacles)
    if len(obstacles) == len(scene.obstacles):
        return scene
    try:
        return scene.replace(obstacles=obstacles)
    except SceneError:  # a drone that only just keeps away from a face which moved by rounding
        return scene


@lru_cache(maxsize=16)  # a scene's travel is asked for several times while it is planned
def merged_obstacles(obstacles: tuple[Obstacle, ...]) -> tuple[Obstacle, ...]:
    """The same obstacles with as few boxes as are found, each with the id, and in the place, of the first box in it.

    Merging what is merged changes nothing.
    """
    kept: dict[int, Obstacle] = {index: obstacle for index, obstacle in enumerate(obstacles) if not isinstance(obstacle, Box)}
    yaws = {obstacle.yaw for obstacle in obstacles if isinstance(obstacle, Box)}
    if len(kept) + len(yaws) > WORTH_SHARE * len(obstacles):  # a box of each yaw is left at least
        return obstacles
    for yaw in yaws:
        numbered = [(index, box) for index, box in enumerate(obstacles) if isinstance(box, Box) and box.yaw == yaw]
        kept |= {numbered[rank][0]: box for rank, box in _blocks([box for _, box in numbered], yaw)}
    return tuple(kept[index] for index in sorted(kept)) if len(kept) <= WORTH_SHARE * len(obstacles) else obstacles


def _blocks(boxes: Sequence[Box], yaw: float) -> Iterator[tuple[int, Box]]:
    """The boxes of one yaw joined, each with the index of the first one in it, which it is itself where it is alone."""
    for low, high, rank in zip(*_fewest(*_corners(boxes, yaw)), strict=True):
        size = high - low
        is_alone = (np.abs(size - boxes[rank].size) <= SAME_FACE_M).all()
        center = _center(low, high, yaw)
        yield int(rank), boxes[rank] if is_alone else replace(boxes[rank], center=center, size=tuple(size.tolist()))


def _corners(boxes: Sequence[Box], yaw: float) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corners (B, 3) m in the frame in which the boxes are not turned."""
    centers, halves = np.array([box.center for box in boxes]), np.array([box.size for box in boxes]) / 2.0
    if yaw != 0.0:
        centers = _turned(centers, -yaw)
    return centers - halves, centers + halves


def _center(low: FloatArray, high: FloatArray, yaw: float) -> tuple[float, float, float]:
    middle = (low + high) / 2.0
    x, y, z = (_turned(middle[None], yaw)[0] if yaw != 0.0 else middle).tolist()
    return x, y, z


def _turned(points: FloatArray, yaw: float) -> FloatArray:
    cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
    x, y = points[:, 0], points[:, 1]
    return np.stack([cos_yaw * x - sin_yaw * y, sin_yaw * x + cos_yaw * y, points[:, 2]], axis=1)


def _fewest(lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Corners of the boxes by the order of axes that leaves the fewest, and the first of the given boxes in each."""
    given = lower, upper, np.arange(len(lower))
    tries = [_joined(*given, axes) for axes in permutations(range(3))]
    return min(tries, key=lambda boxes: len(boxes[0]))


def _joined(
    lower: FloatArray, upper: FloatArray, first: NDArray[np.int64], axes: Sequence[int]
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Boxes joined along one axis after the other until none join."""
    count = len(lower) + 1
    while len(lower) < count:
        count = len(lower)
        for axis in axes:
            lower, upper, first = _joined_along(lower, upper, first, axis)
    return lower, upper, first


def _joined_along(
    lower: FloatArray, upper: FloatArray, first: NDArray[np.int64], axis: int
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Boxes of one cross-section that touch or overlap along an axis made one."""
    across = [other for other in range(3) if other != axis]
    sections = np.rint(np.hstack([lower[:, across], upper[:, across]]) / SAME_FACE_M)  # (B, 4)
    order = np.lexsort((lower[:, axis], *sections.T))
    lower, upper, first, sections = lower[order], upper[order], first[order], sections[order]
    begins = np.ones(len(lower), dtype=np.bool_)
    begins[1:] = (sections[1:] != sections[:-1]).any(axis=1)
    groups = np.flatnonzero(begins)
    reach = np.concatenate([np.maximum.accumulate(part) for part in np.split(upper[:, axis], groups[1:])])
    begins[1:] |= lower[1:, axis] > reach[:-1] + SAME_FACE_M
    starts = np.flatnonzero(begins)
    low, high = np.minimum.reduceat(lower, starts), np.maximum.reduceat(upper, starts)
    return low, high, np.minimum.reduceat(first, starts)
