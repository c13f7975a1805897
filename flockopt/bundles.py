"""Bundles: which drone visits which tasks in which order, and the paper's measures of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockopt.geometry import FloatArray

__all__ = ["Bound", "Bundles"]


@dataclass(frozen=True)
class Bundles:
    """An ordered bundle of tasks for every drone.

    ``bundles[i][r]`` is the index of the r-th task that drone i visits (b_{i,r} in the paper).

    Attributes:
        routes: N tuples of task indices in visiting order.
        unserved: (task index, reason) of every task that no drone visits.
        status: ``"feasible"``, ``"optimal"`` (proven) or ``"infeasible"`` (some task cannot be served).
        reason: Why it is infeasible; empty otherwise.
    """

    routes: tuple[tuple[int, ...], ...]
    unserved: tuple[tuple[int, str], ...] = ()
    status: str = "feasible"
    reason: str = ""

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
        kind: ``"rooted-forest"``, ``"held-karp-forest"`` or ``"ng-route"``.
        value: Metres.
        dual: The vector from which anyone can recompute ``value`` (docs/certificate.md says how for each kind).
    """

    kind: str
    value: float
    dual: FloatArray
