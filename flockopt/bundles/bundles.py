"""Bundles: which drone visits which tasks in which order, and the paper's measures of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.records.status import BUNDLE_STATUSES, Status

if TYPE_CHECKING:
    from flockopt.travel import Travel

__all__ = ["BOUND_EFFORTS", "Bound", "Bundles", "bundle_compactness", "insertion_cost", "tasks_per_drone_std"]

Routes = Sequence[Sequence[int]]

#: How hard a lower bound may be worked for: `flockopt.bundles.bounds.bounds.lower_bound` says by what.
BOUND_EFFORTS = ("fast", "tight", "exact")


@dataclass(frozen=True)
class Bundles:
    """An ordered bundle of tasks for every drone.

    ``bundles[i][r]`` is the index of the r-th task that drone i visits (b_{i,r} in the paper).

    Attributes:
        routes: N tuples of task indices in visiting order.
        unserved: (task index, reason) of every task that no drone visits.
        status: One of `flockopt.records.status.BUNDLE_STATUSES`.
        reason: Why it is infeasible or incomplete; empty otherwise.
    """

    routes: tuple[tuple[int, ...], ...]
    unserved: tuple[tuple[int, str], ...] = ()
    status: Status = Status.FEASIBLE
    reason: str = ""

    def __post_init__(self) -> None:
        if self.status not in BUNDLE_STATUSES:
            rule = f"must be one of {', '.join(BUNDLE_STATUSES)}"
            raise SettingsError("status", f"is {self.status!r}", rule, "correct its spelling")
        object.__setattr__(self, "status", Status(self.status))

    def __getitem__(self, drone: int) -> tuple[int, ...]:
        return self.routes[drone]

    def __len__(self) -> int:
        return len(self.routes)

    def __iter__(self) -> Iterator[tuple[int, ...]]:
        return iter(self.routes)

    def assignment(self, num_tasks: int) -> NDArray[np.bool_]:
        """A in the paper: (N, M), true where drone i serves task j."""
        matrix = np.zeros((len(self.routes), num_tasks), dtype=np.bool_)
        for drone, route in enumerate(self.routes):
            matrix[drone, list(route)] = True
        return matrix


@dataclass(frozen=True)
class Bound:
    """A proven lower bound on the travel of every feasible allocation, with what proves it.

    Attributes:
        kind: ``"two-ended-forest"``, ``"ng-route"``, ``"ng-route-any-end"`` or ``"optimum"``; in older plans also
            ``"rooted-forest"`` or ``"held-karp-forest"``.
        value: Metres.
        dual: The vector from which anyone can recompute ``value`` (docs/certificate.md says how for each kind).
    """

    kind: str
    value: float
    dual: FloatArray


def bundle_compactness(routes: Routes, positions: ArrayLike) -> float | None:
    """How tightly bundles hold together: the paper's spread of co-assigned tasks, free of the scene's size.

    It is the mean distance of tasks from the centroid of their bundle, over bundles of two tasks or more, divided by the
    mean distance of all bundled tasks from their common centroid. (The paper names the measure and gives no formula.)

    Args:
        routes: Bundles of task indices.
        positions: (M, 3) m, of the tasks.

    Returns:
        0 or more, about 1 for bundles drawn at random; None where no bundle has two tasks.
    """
    places = np.asarray(positions, dtype=np.float64)
    shared = [places[list(route)] for route in routes if len(route) > 1]
    if not shared:
        return None
    everything = np.concatenate([places[list(route)] for route in routes if len(route)])
    spread = float(_distances_to_centroid(everything).mean())
    return float(np.concatenate([_distances_to_centroid(bundle) for bundle in shared]).mean()) / spread if spread else None


def _distances_to_centroid(points: FloatArray) -> FloatArray:
    distances: FloatArray = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return distances


def insertion_cost(travel: Travel, routes: Routes) -> float | None:
    """The paper's mean marginal insertion cost: what a task adds to its route, on average over all bundled tasks.

    Returns:
        Metres, the route's length less its length without the task; None without tasks.
    """
    added = [
        travel.route_length(drone, route) - travel.route_length(drone, [*route[:rank], *route[rank + 1 :]])
        for drone, route in enumerate(routes)
        for rank in range(len(route))
    ]
    return float(np.mean(added)) if added else None


def tasks_per_drone_std(routes: Routes) -> float:
    """Standard deviation of the number of tasks over all drones, those without one included."""
    return float(np.std([len(route) for route in routes]))
