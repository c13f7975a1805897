"""The nonlinear program behind smoothing, in CasADi: the states at the joints of quintic pieces, and how long each takes.

One small function describes one piece. A stage's program maps it over all pieces and puts its derivatives in place,
which makes a program of any length in milliseconds; programs are kept, one for each size.

Ipopt is given a convex model of the curvature: the squared Jacobians of what the limits and the jerk's integral are
squares of, and none of the curvature of those themselves (sequential convex quadratic programming, Verschueren et al.
2016). The exact Hessian is indefinite, by products of durations and velocities; Ipopt needs several times as many
iterations with it and ends in worse places.

Everything is in a drone's own units: its greatest speed is 1 and so is its greatest acceleration. Variables are
state, duration, state, …, state, a state being (p, v, a).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SolverFailed, require
from flockopt.flights.smoothing.stages import TERMS, hermite
from flockopt.records.arrays import FloatArray

if TYPE_CHECKING:
    import casadi

__all__ = ["STATE", "STEP", "Answer", "StageGoal", "StageProgram", "load_casadi", "program"]

#: Numbers in a state; from one state to the next, with the duration between them; that a piece depends on.
STATE, STEP, LOCAL = 9, 10, 19

#: Phases of a piece at which acceleration and jerk are held to their limits; speed is by its control points. What passes
#: the limits between them is taken up by flying a little slower.
ACCELERATION_PHASES = (0.0, 0.2, 0.4, 0.6, 0.8)
JERK_PHASES = (0.0, 0.5, 1.0)

#: The first of a piece's limits on speed and on acceleration: those that the state it begins with is held to.
ENTRY_LIMITS = (0, 4)

#: Weight of keeping durations in the model of the curvature. Without it the joint of two pieces flown alike may be anywhere.
DURATION_DAMPING = 0.3

#: The closed form is feasible and near, so that the barrier begins low and little is moved away from the limits. What
#: costs a thousandth is not worth iterations: the answer is acceptable once the cost stands still.
OPTIONS = {
    "print_time": False,
    "error_on_fail": False,
    "calc_lam_p": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.linear_solver": "mumps",
    "ipopt.mumps_pivot_order": 0,
    "ipopt.mumps_scaling": 0,
    "ipopt.max_iter": 40,
    "ipopt.mu_init": 1e-4,
    "ipopt.tol": 1e-3,
    "ipopt.acceptable_iter": 2,
    "ipopt.acceptable_tol": 10.0,
    "ipopt.acceptable_dual_inf_tol": 1e10,
    "ipopt.acceptable_compl_inf_tol": 1.0,
    "ipopt.acceptable_constr_viol_tol": 1e-3,
    "ipopt.acceptable_obj_change_tol": 1e-3,
    "ipopt.bound_push": 1e-4,
    "ipopt.bound_frac": 1e-4,
    "ipopt.slack_bound_push": 1e-4,
    "ipopt.slack_bound_frac": 1e-4,
}


def load_casadi() -> Any:
    """The casadi package.

    Raises:
        MissingExtra: If it is not installed.
    """
    return require("casadi", extra="trajectory")


@dataclass(frozen=True)
class StageGoal:
    """What a stage is to do; weighted sums are over the control points of a piece.

    Attributes:
        time_weight: Of the duration.
        jerk_weight: Of the integral of the squared jerk.
        tightness: (3,), the shares of the greatest speed, acceleration and jerk that may be used.
        max_jerk: The greatest jerk.
        longest: The longest duration of the whole stage.
        passing: (K, 6) weights whose sum is to be at ``places``; zero for none.
        places: (K, 3).
        rows: (K, R, 3, 6) weights whose sums are to be at least ``offsets``; zero for none.
        offsets: (K, R).
    """

    time_weight: float
    jerk_weight: float
    tightness: FloatArray
    max_jerk: float
    longest: float
    passing: FloatArray
    places: FloatArray
    rows: FloatArray
    offsets: FloatArray

    def parameters(self) -> FloatArray:
        """All numbers, a column a piece, as `_piece` reads them."""
        num_pieces, num_rows = self.offsets.shape
        speed, acceleration, jerk = self.tightness
        head = np.tile([self.time_weight, self.jerk_weight, speed, acceleration, jerk * self.max_jerk], (num_pieces, 1))
        rows = self.rows.transpose(0, 3, 2, 1).reshape(num_pieces, 3 * TERMS * num_rows)
        return np.hstack([head, self.passing, self.places, rows, self.offsets]).T


@dataclass(frozen=True)
class Answer:
    """Where the solver ended."""

    variables: FloatArray  # (STEP * K + STATE,)
    iterations: int
    status: str  # Ipopt's own word


@dataclass(frozen=True)
class _Piece:
    """One piece's cost and constraints and their derivatives, as functions of its 19 variables and its parameters."""

    values: casadi.Function
    slopes: casadi.Function
    curvature: casadi.Function
    num_limits: int
    num_constraints: int
    num_parameters: int


@lru_cache(maxsize=8)
def _piece(num_rows: int) -> _Piece:
    """One piece with ``num_rows`` inequalities; its constraints are limits, the place to pass and those."""
    ca = load_casadi()
    z, head = ca.SX.sym("z", LOCAL), ca.SX.sym("head", 5)
    passing, place = ca.SX.sym("passing", TERMS), ca.SX.sym("place", 3)
    rows, offsets = ca.SX.sym("rows", num_rows, 3 * TERMS), ca.SX.sym("offsets", num_rows)
    parameters = ca.vertcat(head, passing, place, ca.vec(rows), offsets)
    control, duration = _control(ca, z), z[STATE]
    velocity = 5 * (control[:, 1:] - control[:, :-1]) / duration
    acceleration = 4 * (velocity[:, 1:] - velocity[:, :-1]) / duration
    jerk = 3 * (acceleration[:, 1:] - acceleration[:, :-1]) / duration
    limited = ca.horzcat(
        velocity[:, :-1] / head[2],
        ca.mtimes(acceleration, _bernstein(3, ACCELERATION_PHASES).T) / head[3],
        ca.mtimes(jerk, _bernstein(2, JERK_PHASES).T) / head[4],
    )  # (3, L), of norms at most 1
    roughness = ca.sqrt(duration) * ca.mtimes(jerk, np.linalg.cholesky(_inner_products(2)))  # squared: the jerk's integral
    cost = head[0] * duration + head[1] * ca.sumsqr(roughness)
    constraints = ca.vertcat(
        ca.sum1(limited**2).T, ca.mtimes(control, passing) - place, ca.mtimes(rows, ca.vec(control)) - offsets
    )
    cost_weight, multipliers = ca.SX.sym("cost_weight"), ca.SX.sym("multipliers", constraints.shape[0])
    pull = ca.vec(ca.repmat(ca.fmax(multipliers[: limited.shape[1]], 0).T, 3, 1))
    damping = ca.SX(LOCAL, LOCAL)
    damping[STATE, STATE] = DURATION_DAMPING * cost_weight * head[0] / duration
    curvature = 2 * (_gram(ca, limited, pull, z) + _gram(ca, roughness, cost_weight * head[1], z)) + damping
    slopes = [ca.gradient(cost, z), ca.jacobian(constraints, z)]
    return _Piece(
        values=ca.Function("values", [z, parameters], [cost, constraints]),
        slopes=ca.Function("slopes", [z, parameters], [cost, constraints, *(ca.densify(slope) for slope in slopes)]),
        curvature=ca.Function("curvature", [z, parameters, cost_weight, multipliers], [ca.densify(curvature)]),
        num_limits=limited.shape[1],
        num_constraints=constraints.shape[0],
        num_parameters=parameters.shape[0],
    )


def _control(ca: Any, z: Any) -> Any:
    """Control points (3, 6) of a piece."""
    powers = ca.diag(ca.vertcat(1, z[STATE], z[STATE] ** 2))
    states = [ca.mtimes(ca.reshape(state, 3, 3), powers) for state in (z[:STATE], z[STEP:])]
    begin, end = (ca.sparsify(ca.DM(matrix.T)) for matrix in hermite())
    return ca.mtimes(states[0], begin) + ca.mtimes(states[1], end)


def _gram(ca: Any, values: Any, weights: Any, z: Any) -> Any:
    """The Jacobian's weighted square, (19, 19)."""
    jacobian = ca.jacobian(ca.vec(values), z)
    return ca.mtimes(jacobian.T, weights * jacobian if weights.is_scalar() else ca.mtimes(ca.diag(weights), jacobian))


def _bernstein(degree: int, phases: tuple[float, ...]) -> FloatArray:
    """Values (P, degree + 1) of the Bernstein polynomials."""
    phase, i = np.array(phases)[:, None], np.arange(degree + 1)
    return np.array([math.comb(degree, k) for k in i]) * phase**i * (1.0 - phase) ** (degree - i)


def _inner_products(degree: int) -> FloatArray:
    """Integrals (degree + 1, degree + 1) over [0, 1] of products of two Bernstein polynomials."""
    binomial = np.array([math.comb(degree, i) for i in range(degree + 1)])
    joint = np.array([[math.comb(2 * degree, i + j) for j in range(degree + 1)] for i in range(degree + 1)])
    return np.outer(binomial, binomial) / joint / (2 * degree + 1)


class StageProgram:
    """The program of a stage of ``num_pieces`` pieces with ``num_rows`` inequalities on each."""

    def __init__(self, num_pieces: int, num_rows: int) -> None:
        ca, piece = load_casadi(), _piece(num_rows)
        self.num_pieces, self.num_rows, self.num_limits = num_pieces, num_rows, piece.num_limits
        size, height = STEP * num_pieces + STATE, piece.num_constraints * num_pieces + 1
        x, p = ca.MX.sym("x", size), ca.MX.sym("p", piece.num_parameters, num_pieces)
        cost_weight, multipliers = ca.MX.sym("cost_weight"), ca.MX.sym("multipliers", height)
        columns = STEP * np.arange(num_pieces)[:, None] + np.arange(LOCAL)  # (K, 19) variables of a piece
        lines = piece.num_constraints * np.arange(num_pieces)[:, None] + np.arange(piece.num_constraints)
        durations = columns[:, STATE]
        local, total = ca.reshape(x[columns.ravel().tolist()], LOCAL, num_pieces), ca.sum1(x[durations.tolist()])

        costs, constraints = piece.values.map(num_pieces)(local, p)
        f, g = ca.sum2(costs), ca.vertcat(ca.vec(constraints), total)
        costs, constraints, gradients, jacobians = piece.slopes.map(num_pieces)(local, p)
        gradient = ca.densify(_assembled(columns.ravel(), np.zeros(columns.size, int), (size, 1), ca.vec(gradients)))
        down = np.concatenate([np.tile(lines, LOCAL).ravel(), np.full(num_pieces, height - 1)])
        across = np.concatenate([np.repeat(columns, piece.num_constraints, axis=1).ravel(), durations])
        jacobian = _assembled(down, across, (height, size), ca.vertcat(ca.vec(jacobians), ca.MX.ones(num_pieces)))
        pulls = ca.reshape(multipliers[:-1], piece.num_constraints, num_pieces)
        blocks = piece.curvature.map(num_pieces)(local, p, cost_weight, pulls)
        down, across = np.tile(columns, LOCAL).ravel(), np.repeat(columns, LOCAL, axis=1).ravel()
        curvature = ca.triu(_assembled(down, across, (size, size), ca.vec(blocks)))

        inputs = ["x", "p", "lam_f", "lam_g"]
        derivatives = {
            "grad_f": ca.Function("nlp_grad_f", [x, p], [ca.sum2(costs), gradient], inputs[:2], ["f", "grad_f_x"]),
            "jac_g": ca.Function(
                "nlp_jac_g", [x, p], [ca.vertcat(ca.vec(constraints), total), jacobian], inputs[:2], ["g", "jac_g_x"]
            ),
            "hess_lag": ca.Function(
                "nlp_hess_l", [x, p, cost_weight, multipliers], [curvature], inputs, ["triu_hess_gamma_x_x"]
            ),
        }
        self._in_use = Lock()  # a solver keeps the numbers of its last run, which another thread must not mix with its own
        self._solver = ca.nlpsol("smooth", "ipopt", {"x": x, "p": p, "f": f, "g": g}, {**OPTIONS, **derivatives})

    def solve(self, task: StageGoal, guess: FloatArray, lower: FloatArray, upper: FloatArray) -> Answer:
        """Solve from a guess of the variables within bounds on them, each (STEP * K + STATE,).

        Raises:
            SolverFailed: If CasADi or Ipopt crash; not finding an answer is a status.
        """
        floor, ceiling = self._bounds(task, guess)
        with self._in_use:
            try:
                found = self._solver(x0=guess, p=task.parameters(), lbx=lower, ubx=upper, lbg=floor, ubg=ceiling)
                stats = self._solver.stats()
            except RuntimeError as fault:
                raise SolverFailed("ipopt", str(fault)) from None
        return Answer(np.array(found["x"]).ravel(), int(stats["iter_count"]), str(stats["return_status"]))

    def _bounds(self, task: StageGoal, guess: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Bounds on all constraints; unused ones have none, and the state it begins with is given as it is."""
        shape, limits = (self.num_pieces, self.num_limits + 3 + self.num_rows), self.num_limits
        floor, ceiling = np.full(shape, -np.inf), np.full(shape, np.inf)
        ceiling[:, :limits] = 1.0
        entry = np.linalg.norm(guess[3:STATE].reshape(2, 3), axis=1) / task.tightness[:2]
        ceiling[0, ENTRY_LIMITS] = np.maximum(entry**2, 1.0)
        passed = task.passing.any(axis=1)
        floor[passed, limits : limits + 3] = ceiling[passed, limits : limits + 3] = 0.0
        floor[:, limits + 3 :] = np.where(task.rows.any(axis=(2, 3)), 0.0, -np.inf)
        return np.append(floor, -np.inf), np.append(ceiling, task.longest)


def _assembled(down: NDArray[np.int64], across: NDArray[np.int64], shape: tuple[int, int], numbers: Any) -> Any:
    """A sparse matrix in which ``numbers`` are added up at rows ``down`` and columns ``across``."""
    ca = load_casadi()
    places, which = np.unique(across * shape[0] + down, return_inverse=True)  # column after column, as CasADi stores them
    sparsity = ca.Sparsity.triplet(*shape, (places % shape[0]).tolist(), (places // shape[0]).tolist())
    adding = ca.DM.triplet(which.tolist(), list(range(len(down))), ca.DM.ones(len(down)), len(places), len(down))
    return ca.MX(sparsity, ca.mtimes(adding, numbers))


@lru_cache(maxsize=64)
def program(num_pieces: int, num_rows: int) -> StageProgram:
    """The program of this size, built once."""
    return StageProgram(num_pieces, num_rows)
