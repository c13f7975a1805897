"""Voxel scenes as octomap and point clouds give them: walls, floors of blocks and blobs, a box a voxel."""

from __future__ import annotations

import numpy as np

from flockopt import Bounds, Box, Drone, Scene, Task

#: Metres.
SIDE = 0.25

#: Voxels along x, y, z.
SHAPE = (80, 80, 20)


def occupied(seed: int, *, blobs: int = 8) -> np.ndarray:
    """Which voxels (X, Y, Z) are filled: two walls, each with an opening, and balls."""
    rng = np.random.default_rng(seed)
    filled = np.zeros(SHAPE, dtype=bool)
    filled[25] = True
    filled[25, 30:40, :12] = False
    filled[52:54, :, :15] = True
    filled[52:54, 58:68] = False
    where = np.stack(np.indices(SHAPE), axis=-1) + 0.5
    for center in rng.uniform((6, 6, 2), np.array(SHAPE) - (6, 6, 2), (blobs, 3)):
        filled |= np.linalg.norm(where - center, axis=-1) < rng.uniform(2.0, 5.0)
    return filled


def voxel_scene(seed: int = 0, *, drones: int = 6, tasks: int = 12, blobs: int = 8) -> Scene:
    """A scene whose obstacles are voxels, with starts and tasks well clear of them."""
    filled = occupied(seed, blobs=blobs)
    rng = np.random.default_rng(seed + 1)
    boxes = tuple(
        Box(f"v{index}", tuple(((voxel + 0.5) * SIDE).tolist()), (SIDE,) * 3) for index, voxel in enumerate(np.argwhere(filled))
    )
    upper = np.array(SHAPE) * SIDE
    centers = (np.argwhere(filled) + 0.5) * SIDE
    places: list[np.ndarray] = []
    while len(places) < drones + tasks:
        place = rng.uniform(1.0, upper - 1.0)
        apart = all(np.linalg.norm(place - other) > 1.2 for other in places)
        if apart and np.linalg.norm(centers - place, axis=1).min() > 0.8:
            places.append(place)
    points = [tuple(place.tolist()) for place in places]
    capacity = -(-tasks // drones) + 1
    return Scene(
        f"voxels-{seed}",
        Bounds((0, 0, 0), tuple(upper.tolist())),
        tuple(Drone(f"d{i}", points[i], capacity, 0.12, 2, 4, 30) for i in range(drones)),
        tuple(Task(f"t{j}", points[drones + j]) for j in range(tasks)),
        boxes,
        clearance=0.1,
        separation=0.4,
    )
