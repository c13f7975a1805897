"""Assignment by linear programming, with primal, dual and residuals: who serves what.

`transport` turns preferences into a capacity-feasible assignment: the transport polytope's vertices are integral for
unit demands; heavier ones are rounded so that capacities hold. The program is solved by Clarabel through cvxpy, built
once per size; unit demands have a fast path through scipy's assignment that agrees with it. Whatever a solver says,
values and residuals are computed here from the vectors alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, linear_sum_assignment, milp
from scipy.sparse import csr_array

from flockopt.batches.deadline import heard
from flockopt.errors import SettingsError, SolverFailed, require
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene

__all__ = ["Residuals", "Transport", "transport"]

#: How hard to round: enough for fleets of some dozens, and the same on every machine.
EFFORT = {"node_limit": 500, "mip_rel_gap": 1e-4}

#: Problems kept built: sizes in use at a time are few.
KEPT_PROBLEMS = 16

#: One thread at a time: cvxpy solves a problem by writing into it, and numbers the parts of all problems by one counter.
_ONE_AT_A_TIME = Lock()


@dataclass(frozen=True)
class Residuals:
    """How far a pair of vectors is from optimal, recomputed from the problem.

    Attributes:
        primal: Largest breach of a primal constraint.
        gap: What the dual's value is off the primal's; >= 0 up to rounding proves near-optimality.
    """

    primal: float
    gap: float


@dataclass(frozen=True)
class Transport:
    """A capacity-feasible assignment of greatest preference.

    Attributes:
        assignment: (N, M), true where drone i serves task j; a column is empty where no capacity was left.
        primal: (N, M) shares in [0, 1].
        drone_prices: (N,) >= 0, of a unit of capacity.
        task_prices: (M,), of being served.
        residuals: Of primal and prices.
    """

    assignment: NDArray[np.bool_]
    primal: FloatArray
    drone_prices: FloatArray
    task_prices: FloatArray
    residuals: Residuals


def transport(scene: Scene, preferences: FloatArray, *, solver: str = "auto") -> Transport:
    """Assign tasks to drones within capacities, so that the sum of preferences is greatest.

    Args:
        scene: Whose capacities and demands count.
        preferences: (N, M) >= 0.
        solver: ``"clarabel"``, ``"scipy"`` (unit demands only) or ``"auto"``: scipy where it serves.

    Raises:
        SettingsError: On an unknown solver, or scipy for demands above one.
        MissingExtra: If cvxpy is not installed where it is needed.
        SolverFailed: If Clarabel fails.
    """
    if solver not in ("auto", "clarabel", "scipy"):
        raise SettingsError("solver", f"is {solver!r}", "must be auto, clarabel or scipy", "choose one")
    is_unit = bool((scene.demands == 1.0).all())
    if solver == "scipy" and not is_unit:
        raise SettingsError("solver", "is 'scipy'", "serves unit demands only", "use clarabel")
    if is_unit and solver != "clarabel":
        primal = _slots(preferences, scene.capacities)
        prices = _slot_prices(preferences, primal, scene.capacities)
    else:
        primal, prices = _clarabel_transport(preferences, scene.demands, scene.capacities)
    prices = np.maximum(prices, 0.0)
    task_prices = np.maximum((preferences - prices[:, None] * scene.demands).max(axis=0, initial=0.0), 0.0)
    value = float(task_prices.sum() + prices @ scene.capacities)
    load = primal @ scene.demands - scene.capacities
    breach = max(load.max(initial=0.0), (primal.sum(axis=0) - 1.0).max(initial=0.0), -primal.min(initial=0.0))
    residuals = Residuals(float(breach), value - float((preferences * primal).sum()))
    return Transport(_rounded(primal, preferences, scene), primal, prices, task_prices, residuals)


def _slots(preferences: FloatArray, capacities: FloatArray) -> FloatArray:
    """(N, M) of zeros and ones: every unit of capacity is a slot that takes one task."""
    num_tasks = preferences.shape[1]
    owner = np.repeat(np.arange(len(capacities)), np.minimum(capacities, num_tasks).astype(np.int64))
    slot, task = linear_sum_assignment(preferences[owner], maximize=True)
    primal = np.zeros(preferences.shape)
    primal[owner[slot], task] = 1.0
    return primal


def _slot_prices(preferences: FloatArray, primal: FloatArray, capacities: FloatArray) -> FloatArray:
    """(N,) prices that prove an assignment optimal: longest ways in the graph of exchanges (Bellman, Ford).

    Moving a task from its drone to another one gains the difference of preferences; a drone's price is the most
    that a unit of its capacity could gain along a chain of moves that ends at a task left out.
    """
    num_drones = len(capacities)
    owner = np.where(primal.any(axis=0), primal.argmax(axis=0), -1)
    gain = np.full((num_drones, num_drones), -np.inf)  # what drone i gains by taking a task from drone k
    for k in range(num_drones):
        tasks = np.flatnonzero(owner == k)
        if len(tasks):
            gain[:, k] = (preferences[:, tasks] - preferences[k, tasks]).max(axis=1)
    prices = np.maximum(preferences[:, owner < 0].max(axis=1, initial=0.0), 0.0)
    for _ in range(num_drones):
        prices = np.maximum(prices, (gain + prices[None, :]).max(axis=1, initial=0.0))
    spare = primal.sum(axis=1) < capacities
    return np.where(spare, 0.0, prices)


@lru_cache(maxsize=KEPT_PROBLEMS)
def _transport_problem(num_drones: int, num_tasks: int) -> tuple[Any, ...]:
    """The program of one size, compiled once: problem, variable, parameters, and the constraint on capacities."""
    cp = _cvxpy()
    share = cp.Variable((num_drones, num_tasks), nonneg=True)
    preference = cp.Parameter((num_drones, num_tasks))
    demand, capacity = cp.Parameter(num_tasks, nonneg=True), cp.Parameter(num_drones, nonneg=True)
    within = share @ demand <= capacity
    once = cp.sum(share, axis=0) <= 1
    problem = cp.Problem(cp.Maximize(cp.sum(cp.multiply(preference, share))), [within, once])
    return problem, share, (preference, demand, capacity), within


def _clarabel_transport(preferences: FloatArray, demands: FloatArray, capacities: FloatArray) -> tuple[FloatArray, FloatArray]:
    with _ONE_AT_A_TIME:
        problem, share, (preference, demand, capacity), within = _transport_problem(*preferences.shape)
        preference.value, demand.value, capacity.value = preferences, demands, capacities
        _solve(problem)
        return np.array(share.value), np.array(within.dual_value)


def _cvxpy() -> Any:
    return require("cvxpy", extra="solvers")


def _solve(problem: Any) -> None:
    cp = _cvxpy()
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as fault:
        raise SolverFailed("Clarabel", str(fault)) from fault
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise SolverFailed("Clarabel", f"status {problem.status}")


def _rounded(primal: FloatArray, preferences: FloatArray, scene: Scene) -> NDArray[np.bool_]:
    """The integral assignment nearest to the shares that keeps capacities; as many tasks served as can be.

    Shares that are integral stay; others are settled by a small generalised assignment problem (HiGHS through scipy).
    """
    if (np.abs(primal - primal.round()) < 1e-9).all():
        return np.asarray(primal > 0.5)
    num_drones, num_tasks = primal.shape
    serve = float(num_drones * num_tasks)  # serving one more task outweighs all shares together
    weights = -(serve + primal + 1e-3 * preferences / max(float(preferences.max()), 1e-12)).ravel()
    drone, task = np.divmod(np.arange(num_drones * num_tasks), num_tasks)
    columns = np.arange(num_drones * num_tasks)
    loads = csr_array((scene.demands[task], (drone, columns)), shape=(num_drones, num_drones * num_tasks))
    visits = csr_array((np.ones(len(columns)), (task, columns)), shape=(num_tasks, num_drones * num_tasks))
    limits = [LinearConstraint(loads, -np.inf, scene.capacities), LinearConstraint(visits, -np.inf, 1.0)]
    answer = heard(
        lambda: milp(weights, constraints=limits, integrality=np.ones(len(columns)), bounds=Bounds(0.0, 1.0), options=EFFORT)
    )
    if answer.x is None:
        raise SolverFailed("HiGHS", answer.message)
    return np.asarray(answer.x.reshape(num_drones, num_tasks) > 0.5)
