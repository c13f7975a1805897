"""CP-SAT of OR-Tools, asked in one way: by a measure of work that is the same on every machine, and heard by the keyboard."""

from __future__ import annotations

import sys
from typing import Any

from flockopt.batches.deadline import NEVER, Deadline, heard
from flockopt.errors import SolverFailed, require

__all__ = ["cp_model", "is_at_hand", "solved"]

#: How long loading it may take, seconds.
LOADING_S = 1.5


def cp_model() -> Any:
    """OR-Tools' module of the same name.

    Raises:
        MissingExtra: If OR-Tools is not installed.
    """
    return require("ortools.sat.python.cp_model", extra="solvers")


def is_at_hand(deadline: Deadline) -> bool:
    """Whether it is loaded, or there is time to load it."""
    return "ortools.sat.python.cp_model" in sys.modules or deadline.left_s > LOADING_S


def solved(model: Any, work: float, deadline: Deadline = NEVER) -> tuple[Any, Any]:
    """The solver that has solved a model, by one thread, and its status.

    Args:
        model: A ``CpModel``.
        work: Its own deterministic seconds, at most.
        deadline: When to stop, if earlier.

    Raises:
        SolverFailed: If the model is not valid.
    """
    module = cp_model()
    solver = module.CpSolver()
    parameters = solver.parameters
    parameters.num_workers, parameters.random_seed, parameters.max_deterministic_time = 1, 0, work
    parameters.catch_sigint_signal = False  # it would end the solver, and nobody else would hear of it
    if not deadline.is_never:
        parameters.max_time_in_seconds = max(deadline.left_s, 0.0)
    status = heard(lambda: solver.solve(model), solver.stop_search)
    if status == module.MODEL_INVALID:
        raise SolverFailed("CP-SAT", model.validate())
    return solver, status
