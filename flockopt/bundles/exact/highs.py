"""HiGHS behind one small class: a program over 0/1 columns, solved relaxed or not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.batches.deadline import heard
from flockopt.errors import MissingExtra, SolverFailed
from flockopt.records.arrays import FloatArray

__all__ = ["HighsProgram", "Solution"]

#: Branch and bound ends where bound and solution are this close, metres.
LEAST_MIP_GAP_M = 1e-7


@dataclass(frozen=True)
class Solution:
    """What HiGHS answers.

    Attributes:
        status: ``"optimal"``, ``"infeasible"`` or ``"stopped"`` by the time limit.
        values: (R,) of the columns, None where no solution is known.
        duals: (rows,) of a linear program, else empty.
        bound: No solution costs less.
    """

    status: str
    values: FloatArray | None
    duals: FloatArray
    bound: float


class HighsProgram:
    """Minimise ``costs @ x`` over 0 <= x <= 1 with ``lower <= A x <= upper``; rows and columns may be added.

    Args:
        costs: (R,).
        starts: (R + 1,) where each column's rows start in ``rows``.
        rows: The rows in which a column has a one.
        lower: (rows,).
        upper: (rows,).

    Raises:
        MissingExtra: If highspy is not installed.
        SolverFailed: If it does not load.
    """

    def __init__(
        self, costs: FloatArray, starts: NDArray[np.int32], rows: NDArray[np.int32], lower: FloatArray, upper: FloatArray
    ) -> None:
        try:
            import highspy
        except ModuleNotFoundError:
            raise MissingExtra("highspy", "solvers") from None
        except ImportError as fault:  # such as the symbols of another HiGHS that this process has loaded
            raise SolverFailed("HiGHS", str(fault)) from fault
        self._api: Any = highspy
        self._highs = highspy.Highs()
        self._highs.setOptionValue("output_flag", False)
        # Presolve of HiGHS 1.14 has claimed an optimum that broke a row; a proof cannot stand on that.
        self._highs.setOptionValue("presolve", "off")
        model = highspy.HighsLp()
        model.num_col_, model.num_row_ = len(costs), len(lower)
        model.col_cost_, model.col_lower_, model.col_upper_ = costs, np.zeros(len(costs)), np.ones(len(costs))
        model.row_lower_, model.row_upper_ = lower, upper
        model.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        model.a_matrix_.start_, model.a_matrix_.index_, model.a_matrix_.value_ = starts, rows, np.ones(len(rows))
        self._check(self._highs.passModel(model), "the model was refused")

    def add_rows(self, members: NDArray[np.bool_], lower: FloatArray, upper: FloatArray) -> None:
        """Rows that keep the sum of the columns marked in ``members`` (rows, R) within (rows,) limits."""
        columns = np.nonzero(members)[1].astype(np.int32)
        starts = np.concatenate([[0], np.cumsum(members.sum(axis=1))[:-1]]).astype(np.int32)
        status = self._highs.addRows(len(members), lower, upper, len(columns), starts, columns, np.ones(len(columns)))
        self._check(status, "rows were refused")

    def add_columns(self, costs: FloatArray, starts: NDArray[np.int32], rows: NDArray[np.int32]) -> None:
        """More columns, given as at first."""
        zeros, ones = np.zeros(len(costs)), np.ones(len(costs))
        status = self._highs.addCols(len(costs), costs, zeros, ones, len(rows), starts[:-1], rows, np.ones(len(rows)))
        self._check(status, "columns were refused")

    def solve_linear(self, time_limit_s: float) -> Solution:
        """The linear program.

        Raises:
            SolverFailed: If HiGHS ends in any other way than optimal, infeasible or out of time.
        """
        # HiGHS counts the time of all runs of one model together.
        self._highs.setOptionValue("time_limit", self._highs.getRunTime() + max(time_limit_s, 0.0))
        return self._run()

    def solve_integer(self, upper: float, time_limit_s: float) -> Solution:
        """With every column 0 or 1; solutions of cost ``upper`` or more count as none.

        Raises:
            SolverFailed: If HiGHS ends in any other way than optimal, infeasible or out of time.
        """
        count = self._highs.getNumCol()
        kinds = np.full(count, int(self._api.HighsVarType.kInteger), dtype=np.uint8)
        self._check(self._highs.changeColsIntegrality(count, np.arange(count, dtype=np.int32), kinds), "integers were refused")
        self._highs.setOptionValue("mip_rel_gap", 0.0)
        self._highs.setOptionValue("mip_abs_gap", LEAST_MIP_GAP_M)
        self._highs.setOptionValue("objective_bound", upper)
        self._highs.setOptionValue("time_limit", max(time_limit_s, 0.0))
        return self._run()

    def _run(self) -> Solution:
        self._check(heard(self._highs.run), "the run ended in an error")
        status, statuses = self._highs.getModelStatus(), self._api.HighsModelStatus
        if status in (statuses.kInfeasible, statuses.kObjectiveBound):
            return Solution("infeasible", None, np.empty(0), np.inf)
        info, solution = self._highs.getInfo(), self._highs.getSolution()
        found = info.primal_solution_status == self._api.SolutionStatus.kSolutionStatusFeasible
        values = np.array(solution.col_value) if found else None
        if status == statuses.kOptimal:
            return Solution("optimal", values, np.array(solution.row_dual), info.objective_function_value)
        if status == statuses.kTimeLimit:
            return Solution("stopped", values, np.empty(0), info.mip_dual_bound if info.mip_node_count >= 0 else -np.inf)
        raise SolverFailed("HiGHS", f"it ended with status {self._highs.modelStatusToString(status)}")

    def _check(self, status: Any, problem: str) -> None:
        if status == self._api.HighsStatus.kError:
            raise SolverFailed("HiGHS", problem)
