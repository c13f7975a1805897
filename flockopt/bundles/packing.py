"""Whether a fleet's capacities can hold all tasks at all, lengths of routes aside: a packing of demands, or a proof of none.

The largest demand first, into the drone that it fills best; then a search through all other choices, as far as it gets; then
CP-SAT where it is installed. All stop by counts, never by a clock.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.batches import cp_sat
from flockopt.bundles.explain import LENGTH_TOLERANCE_M
from flockopt.errors import MissingExtra
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["Packing", "can_serve", "pack"]

#: Choices that the search tries, and CP-SAT's own measure of its work, at most.
MOST_CHOICES, MOST_WORK = 20_000, 2.0


@dataclass(frozen=True)
class Packing:
    """What is known of a packing.

    Attributes:
        drones: (M,) which drone carries each task; None where no packing was found.
        is_impossible: Whether it is proven that there is none.
    """

    drones: tuple[int, ...] | None = None
    is_impossible: bool = False


def can_serve(scene: Scene, travel: Travel) -> NDArray[np.bool_]:
    """(N, M) whether a drone that serves this task alone keeps its capacity and its ``max_distance``."""
    alone = travel.start_task + travel.task_end
    limits = np.array([np.inf if drone.max_distance is None else drone.max_distance for drone in scene.drones])
    able: NDArray[np.bool_] = (scene.capacities[:, None] >= scene.demands) & np.isfinite(alone)
    return able & (alone <= limits[:, None] + LENGTH_TOLERANCE_M)


def pack(scene: Scene, travel: Travel, *, thorough: bool = True) -> Packing:
    """A drone for each task, so that no capacity is exceeded; ``thorough`` asks CP-SAT where the search comes to no end."""
    able = can_serve(scene, travel)
    demands = [task.demand for task in scene.tasks]
    capacities = [drone.capacity for drone in scene.drones]
    if not able.any(axis=0).all() or sum(demands) > sum(capacities):
        return Packing(is_impossible=True)
    found = _Search(demands, capacities, able).run()
    if found is None and thorough:
        found = _by_cp_sat(demands, capacities, able)
    return found or Packing()


class _Search:
    """Depth first, the largest demand first; drones that are alike in what is left and in what they can serve count once."""

    def __init__(self, demands: list[int], capacities: list[int], able: NDArray[np.bool_]) -> None:
        self._order = sorted(range(len(demands)), key=lambda j: (-demands[j], int(able[:, j].sum()), j))
        self._demands, self._left, self._able = demands, list(capacities), able
        self._kinds = [row.tobytes() for row in able]
        self._choices = MOST_CHOICES

    def run(self) -> Packing | None:
        """A packing, or that there is none; None where the search stopped before its end."""
        chosen: list[int] = []
        options = [self._options(0)] if self._order else []
        while len(chosen) < len(self._order):
            if not options:
                return Packing(is_impossible=True)
            if not options[-1]:
                options.pop()
                if chosen:
                    self._left[chosen[-1]] += self._demands[self._order[len(chosen) - 1]]
                    chosen.pop()
                continue
            if self._choices == 0:
                return None
            self._choices -= 1
            drone = options[-1].pop()
            self._left[drone] -= self._demands[self._order[len(chosen)]]
            chosen.append(drone)
            if len(chosen) < len(self._order):
                options.append(self._options(len(chosen)))
        drones = [0] * len(chosen)
        for task, drone in zip(self._order, chosen, strict=True):
            drones[task] = drone
        return Packing(tuple(drones))

    def _options(self, rank: int) -> list[int]:
        """Drones with room for a task, the one that it fills best last."""
        task = self._order[rank]
        alike = {
            (self._left[i], self._kinds[i]): i
            for i in np.flatnonzero(self._able[:, task]).tolist()
            if self._left[i] >= self._demands[task]
        }
        return sorted(alike.values(), key=lambda i: (-self._left[i], i))


def _by_cp_sat(demands: list[int], capacities: list[int], able: NDArray[np.bool_]) -> Packing | None:
    try:
        cp_model = cp_sat.cp_model()
    except MissingExtra:
        return None
    model = cp_model.CpModel()
    chosen = {(i, j): model.new_bool_var("") for i, j in np.argwhere(able).tolist()}
    for j in range(len(demands)):
        model.add_exactly_one(chosen[i, j] for i in np.flatnonzero(able[:, j]).tolist())
    for i, capacity in enumerate(capacities):
        model.add(sum(demands[j] * chosen[i, j] for j in np.flatnonzero(able[i]).tolist()) <= capacity)
    solver, status = cp_sat.solved(model, MOST_WORK)
    if status == cp_model.INFEASIBLE:
        return Packing(is_impossible=True)
    if status not in (cp_model.OPTIMAL, cp_model.FEASIBLE):
        return None
    taken = {j: i for (i, j), variable in chosen.items() if solver.boolean_value(variable)}
    return Packing(tuple(taken[j] for j in range(len(demands))))
