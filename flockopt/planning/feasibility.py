"""What can be told of a scene before anybody plans it: who stands in whose way for good.

A drone without capacity, without an end and at rest is grounded: it stays where it is for as long as the others fly. (While a
fleet is in the air such a drone may make way: replanning asks nothing here.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from flockopt.bundles import Bundles
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.scene.apart import is_grounded, shares_apart
from flockopt.scene.scene import POSITION_TOLERANCE_M

__all__ = ["grounded_in_the_way"]

#: How many reasons are given before the rest is left out.
MOST_NAMED = 5


def grounded_in_the_way(scene: Scene) -> Bundles | None:
    """Why no plan can be flown although drones that never move are far from all starts; None where none is in the way.

    Returns:
        Empty bundles, infeasible, with the reason and the tasks that nobody can serve.
    """
    grounded = [i for i, drone in enumerate(scene.drones) if is_grounded(drone)]
    if not grounded:
        return None
    ends = list(_ends_near(scene, grounded))
    tasks = dict(_tasks_near(scene, grounded))
    reasons = [*ends, *tasks.values()]
    if not reasons:
        return None
    named = reasons[:MOST_NAMED] + ["..."] * (len(reasons) > MOST_NAMED)
    return Bundles(((),) * scene.num_drones, tuple(tasks.items()), Status.INFEASIBLE, "; ".join(named))


def _ends_near(scene: Scene, grounded: list[int]) -> Iterator[str]:
    """A reason for every end that is too near to a grounded drone."""
    for i, drone in enumerate(scene.drones):
        if drone.end is None:
            continue
        for g in grounded:
            if shares_apart(scene, i, scene.ends[i], g, scene.starts[g : g + 1])[0] < 1.0 - POSITION_TOLERANCE_M:
                metres = math.dist(scene.ends[i], scene.starts[g])
                yield (
                    f"drone {drone.id!r} has its end {metres:.4g} m from where {_stands(scene, g)}, and they must keep "
                    f"{scene.apart_in_words(i, g)} apart; move one of the two"
                )


def _tasks_near(scene: Scene, grounded: list[int]) -> Iterator[tuple[int, str]]:
    """(task, reason) of every task that a grounded drone keeps from each drone that could carry it."""
    able = scene.capacities[:, None] >= scene.demands[None, :]  # (N, M)
    kept_by = np.full(able.shape, -1)
    for g in grounded:
        for i in np.flatnonzero(able.any(axis=1)).tolist():
            shares = shares_apart(scene, i, scene.starts[g], g, scene.task_positions)
            kept_by[i, shares < 1.0 - POSITION_TOLERANCE_M] = g
    for j in np.flatnonzero(able.any(axis=0) & (~able | (kept_by >= 0)).all(axis=0)):
        i = int(np.flatnonzero(able[:, j])[0])
        g = int(kept_by[i, j])
        metres = math.dist(scene.tasks[j].position, scene.starts[g])
        yield (
            int(j),
            f"task {scene.tasks[j].id!r} is {metres:.4g} m from where {_stands(scene, g)}, and a drone that serves it "
            f"must keep {scene.apart_in_words(i, g)} apart; move one of the two, or give the drone that stands there capacity",
        )


def _stands(scene: Scene, g: int) -> str:
    return f"drone {scene.drones[g].id!r}, which has no capacity and no end, stands for good"
