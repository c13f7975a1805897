import numpy as np
import pytest

from flockopt.errors import MissingExtra, SolverFailed
from flockopt.flights.smoothing import casadi_program
from flockopt.flights.smoothing.casadi_program import STATE, STEP, StageGoal, StageProgram, load_casadi, program
from flockopt.flights.smoothing.stages import TERMS, Stage
from flockopt.geometry.bernstein import largest_norm

pytest.importorskip("casadi", reason="CasADi comes with the extra 'trajectory'")

PIECES, ROWS = 3, 2


def task(rng, **fields):
    settings = {
        "time_weight": 0.8,
        "jerk_weight": 0.3,
        "tightness": np.array([0.99, 0.98, 0.97]),
        "max_jerk": 4.0,
        "longest": 100.0,
        "passing": rng.normal(size=(PIECES, TERMS)),
        "places": rng.normal(size=(PIECES, 3)),
        "rows": rng.normal(size=(PIECES, ROWS, 3, TERMS)),
        "offsets": rng.normal(size=(PIECES, ROWS)),
    }
    return StageGoal(**(settings | fields))


@pytest.fixture
def numbers():
    rng = np.random.default_rng(0)
    states, durations = rng.normal(size=(PIECES + 1, 3, 3)), rng.uniform(0.5, 1.5, PIECES)
    x = np.concatenate([np.append(states[k].ravel(), durations[k : k + 1]) for k in range(PIECES + 1)])
    assert len(x) == STEP * PIECES + STATE
    return task(rng), Stage(durations, states, ()), x


def call(name, *arguments):
    return [np.array(value) for value in program(PIECES, ROWS)._solver.get_function(name).call(list(arguments))]


def test_the_program_and_the_stage_agree(numbers):
    """The same cost, places and inequalities, in CasADi and in numpy."""
    task, stage, x = numbers
    cost, parameters = task.time_weight * stage.seconds + task.jerk_weight * stage.squared_jerk, task.parameters()
    assert call("nlp_f", x, parameters)[0] == pytest.approx(cost)
    g = call("nlp_g", x, parameters)[0].ravel()
    assert g[-1] == pytest.approx(stage.seconds)
    blocks = g[:-1].reshape(PIECES, -1)
    passed = np.einsum("kai,ki->ka", stage.control, task.passing) - task.places
    np.testing.assert_allclose(blocks[:, -ROWS - 3 : -ROWS], passed)
    np.testing.assert_allclose(blocks[:, -ROWS:], np.einsum("krai,kai->kr", task.rows, stage.control) - task.offsets)


def test_its_limits_are_the_curves_norms(numbers):
    task, stage, x = numbers
    blocks = call("nlp_g", x, task.parameters())[0].ravel()[:-1].reshape(PIECES, -1)
    greatest = [largest_norm(stage.breakpoints, stage.control, order)[0] for order in (1, 2, 3)]
    seen = [blocks[:, :4].max(), blocks[:, 4:9].max(), blocks[:, 9:12].max()]
    allowed = task.tightness * [1.0, 1.0, task.max_jerk]
    shares = np.sqrt(seen) * allowed / greatest
    assert shares[0] >= 1.0 - 1e-9  # control points hold the whole speed
    assert (shares[1:] <= 1.0 + 1e-9).all()  # phases are on the curve
    assert (shares[1:] > 0.9).all()


def test_first_derivatives_are_differences(numbers):
    task, _, x = numbers
    parameters, step = task.parameters(), 1e-6
    gradient, jacobian = call("nlp_grad_f", x, parameters)[1].ravel(), call("nlp_jac_g", x, parameters)[1]
    for i, unit in enumerate(np.eye(len(x))):
        ahead, behind = x + step * unit, x - step * unit
        change = (call("nlp_f", ahead, parameters)[0] - call("nlp_f", behind, parameters)[0]) / (2 * step)
        assert gradient[i] == pytest.approx(change.item(), rel=1e-5, abs=1e-5)
        change = (call("nlp_g", ahead, parameters)[0] - call("nlp_g", behind, parameters)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, i], change.ravel(), rtol=1e-4, atol=1e-4)


def test_the_curvature_is_convex_and_exact_for_straight_states(numbers):
    """With durations fixed, limits and cost are sums of squares, and the model of their curvature is exact."""
    task, _, x = numbers
    parameters, height = task.parameters(), program(PIECES, ROWS)._solver.numel_out("g")
    pulls = np.random.default_rng(1).uniform(size=height)
    upper = call("nlp_hess_l", x, parameters, 0.7, pulls)[0]
    curvature = np.triu(upper) + np.triu(upper, 1).T
    assert np.linalg.eigvalsh(curvature).min() > -1e-8
    fixed = np.isin(np.arange(len(x)), np.arange(STATE, len(x), STEP))
    step = 1e-4

    def slope(at):
        gradient, jacobian = call("nlp_grad_f", at, parameters)[1], call("nlp_jac_g", at, parameters)[1]
        return 0.7 * gradient.ravel() + jacobian.T @ pulls

    for i in np.flatnonzero(~fixed):
        unit = np.eye(len(x))[i]
        change = (slope(x + step * unit) - slope(x - step * unit)) / (2 * step)
        np.testing.assert_allclose(curvature[i, ~fixed], change[~fixed], rtol=1e-4, atol=1e-4)


def test_it_solves_what_has_a_known_answer():
    """From rest to rest, for jerk alone: the minimum-jerk quintic, 60 s**3 - 90 s**4 + 36 s**5 in jerk, costs 720 / T**5."""
    rng = np.random.default_rng(0)
    far = {"max_jerk": 1e6, "tightness": np.full(3, 1e6), "longest": 3.0}
    free = {"passing": np.zeros((PIECES, TERMS)), "rows": np.zeros((PIECES, ROWS, 3, TERMS))}
    states = np.zeros((PIECES + 1, 3, 3))
    states[:, 0, 0] = np.linspace(0, 1, PIECES + 1)
    durations = np.full(PIECES, 0.8)
    x = np.concatenate([np.append(states[k].ravel(), durations[k : k + 1]) for k in range(PIECES + 1)])
    lower, upper = np.full(len(x), -np.inf), np.full(len(x), np.inf)
    lower[STATE::STEP], upper[STATE::STEP] = 0.3, 2.0
    for ends in (slice(STATE), slice(-STATE, None)):
        lower[ends] = upper[ends] = x[ends]
    answer = program(PIECES, ROWS).solve(task(rng, time_weight=0.0, jerk_weight=1.0, **far, **free), x, lower, upper)
    stage = Stage(
        answer.variables[STATE::STEP], np.array([answer.variables[STEP * k :][:STATE] for k in range(4)]).reshape(4, 3, 3), ()
    )
    assert stage.seconds == pytest.approx(3.0, abs=0.01)
    assert stage.squared_jerk == pytest.approx(720 / stage.seconds**5, rel=0.01)


def test_programs_are_built_once(monkeypatch):
    built = []

    class Counted(StageProgram):
        def __init__(self, *size):
            built.append(size)
            super().__init__(*size)

    monkeypatch.setattr(casadi_program, "StageProgram", Counted)
    program.cache_clear()
    assert program(2, 4) is program(2, 4)
    program(3, 4)
    program(2, 4)
    assert built == [(2, 4), (3, 4)]
    program.cache_clear()


def test_a_crash_is_named(numbers):
    task, _, x = numbers
    bounds = np.full(len(x), np.inf)
    with pytest.raises(SolverFailed, match="ipopt"):
        program(PIECES, ROWS).solve(task, x, -bounds, bounds[:-1])


def test_without_casadi_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "casadi", None)
    with pytest.raises(MissingExtra, match=r"flockopt\[trajectory\]"):
        load_casadi()
