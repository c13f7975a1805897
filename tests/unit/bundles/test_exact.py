"""The exact method: what it says where time, room or a solver runs out, and the steps it is made of."""

import itertools
import math
import sys
from dataclasses import replace

import numpy as np
import pytest

from flockopt.bundles import Bundles
from flockopt.bundles.bounds.bounds import first_prices
from flockopt.bundles.bounds.pricing import ascend_prices, evaluate, group_drones
from flockopt.bundles.exact import exact
from flockopt.bundles.exact.cuts import violated_cuts
from flockopt.bundles.exact.enumeration import enumerate_routes
from flockopt.bundles.exact.exact import solve_exact
from flockopt.bundles.exact.highs import HighsProgram
from flockopt.errors import MissingExtra, SettingsError, SolverFailed
from flockopt.scene import Bounds, Drone, Scene, Task
from flockopt.travel.travel import straight_travel
from tests.instances import random_instance


def instance(seed=0, **changes):
    settings = {"drones": 4, "tasks": 14, "capacity": 4} | changes
    return random_instance(np.random.default_rng(seed), **settings)


def row_of_columns(costs, columns, lower, upper):
    """A program of 0/1 columns, each with a one in the rows that are named."""
    starts = np.cumsum([0, *map(len, columns)]).astype(np.int32)
    rows = np.array(list(itertools.chain(*columns)), dtype=np.int32)
    return HighsProgram(np.array(costs, float), starts, rows, np.array(lower, float), np.array(upper, float))


def test_optimal_bundles_are_proven_and_carry_a_checkable_bound():
    scene, travel = instance()
    result = solve_exact(scene, travel)
    assert result.status == result.bundles.status == "optimal"
    assert result.proven == travel.total(result.bundles.routes)
    assert result.bound.kind == "ng-route"
    assert evaluate(group_drones(scene, travel), result.bound.dual)[0] == result.bound.value <= result.proven


def test_no_time_means_no_claim():
    scene, travel = instance(tasks=30, capacity=8)
    result = solve_exact(scene, travel, time_limit_s=0.0)
    assert result.status == "feasible"
    assert sorted(task for route in result.bundles for task in route) == list(range(30))
    assert result.proven < travel.total(result.bundles.routes)


def test_lists_that_overflow_end_with_a_bound(monkeypatch):
    monkeypatch.setattr(exact, "FIRST_ROUTES", 3)
    monkeypatch.setattr(exact, "MOST_ROUTES", 3)
    scene, travel = instance(seed=2)
    optimum = travel.total(solve_exact_afresh(scene, travel).routes)
    result = solve_exact(scene, travel)
    assert result.bound.value <= result.proven <= optimum * (1 + 1e-9)
    assert result.status == "optimal" if result.proven >= optimum * (1 - 1e-7) else "feasible"


def solve_exact_afresh(scene, travel):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exact, "FIRST_ROUTES", 50_000)
        patch.setattr(exact, "MOST_ROUTES", 200_000)
        return solve_exact(scene, travel).bundles


@pytest.mark.parametrize("first", [1e-4, 1e-3, 0.1])
def test_the_optimum_does_not_depend_on_where_the_lists_begin(monkeypatch, first):
    scene, travel = instance(seed=3)
    expected = solve_exact(scene, travel).proven
    monkeypatch.setattr(exact, "FIRST_GAP_SHARE", first)
    monkeypatch.setattr(exact, "search", lambda *_, **__: ((),) * scene.num_drones)  # and no allocation is known
    result = solve_exact(scene, travel)
    assert result.status == "optimal" and result.proven == pytest.approx(expected, rel=1e-7)


def test_a_good_warm_start_is_kept():
    scene, travel = instance()
    best = solve_exact(scene, travel).bundles
    assert solve_exact(scene, travel, warm_start=best, time_limit_s=0.0).bundles.routes == best.routes


def test_nothing_to_do_is_optimal():
    scene, travel = instance(tasks=0, ends=True)
    result = solve_exact(scene, travel)
    assert result.status == "optimal"
    assert result.bundles.routes == ((),) * 4 and result.proven == pytest.approx(travel.start_end.sum())


def test_demands_that_cannot_be_packed_are_proven_infeasible():
    # Three tasks of two in two drones of three: enough in sum, not in pieces.
    drones = tuple(Drone(f"d{i}", (float(i), 0, 0), 3, 0.1, 1, 1, 1) for i in range(2))
    tasks = tuple(Task(f"t{j}", (float(j), 1, 0), 2) for j in range(3))
    scene = Scene("packed", Bounds((0, 0, 0), (9, 9, 9)), drones, tasks)
    result = solve_exact(scene, straight_travel(scene))
    assert result.status == "infeasible" and result.proven == math.inf
    assert result.bundles.unserved and result.bundles.reason


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_bad_time_limits_are_named(value):
    with pytest.raises(SettingsError) as caught:
        solve_exact(*instance(), time_limit_s=value)
    assert caught.value.field == "time_limit_s"


def test_a_missing_solver_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "highspy", None)
    with pytest.raises(MissingExtra, match=r"flockopt\[solvers\]"):
        solve_exact(*instance(seed=2))


def test_a_solver_that_does_not_load_or_refuses_is_named(monkeypatch):
    with pytest.raises(SolverFailed, match="HiGHS failed: the model was refused"):
        HighsProgram(np.ones(1), np.array([0, 1], np.int32), np.array([7], np.int32), np.ones(1), np.ones(1))
    broken = type(sys)("highspy")
    broken.__getattr__ = lambda name: (_ for _ in ()).throw(ImportError("undefined symbol"))
    monkeypatch.setitem(sys.modules, "highspy", broken)
    with pytest.raises((SolverFailed, ImportError)):
        row_of_columns([1.0], [[0]], [1], [1])


def test_a_program_tells_what_is_optimal_and_what_cannot_be():
    program = row_of_columns([3.0, 2.0, 2.0], [[0, 1], [0], [1]], [1, 1], [1, 1])
    solution = program.solve_linear(math.inf)
    assert solution.status == "optimal" and solution.bound == pytest.approx(3.0)
    program.add_rows(np.array([[True, False, False]]), np.zeros(1), np.zeros(1))
    assert program.solve_integer(math.inf, math.inf).values.tolist() == [0, 1, 1]
    assert row_of_columns([1.0], [[0]], [2], [2]).solve_linear(math.inf).status == "infeasible"


@pytest.mark.parametrize("seed", range(4))
def test_the_list_holds_every_route_within_the_gap_and_no_other(seed):
    rng = np.random.default_rng(seed)
    scene, travel = random_instance(rng, drones=2, tasks=6, capacity=[3, 5], ends=seed % 2 == 0, demands=seed % 3 == 0)
    groups = group_drones(scene, travel)
    _, prices = ascend_prices(groups, first_prices(scene, travel), rounds=40, upper=math.inf)
    limits, expected = np.array([math.inf, 40.0]), set()
    least = [travel.start_end[i] for i in range(2)]  # of what each drone can have; the list's own bound is at most that
    routes = [(i, order) for i in range(2) for k in range(1, 6) for order in itertools.permutations(range(6), k)]
    shortest: dict[tuple[int, frozenset], float] = {}
    for i, order in routes:
        length = travel.route_length(i, order)
        if scene.demands[list(order)].sum() <= scene.drones[i].capacity:
            least[i] = min(least[i], length - prices[list(order)].sum())
            key = (i, frozenset(order))
            shortest[key] = min(shortest.get(key, math.inf), length)
    expected = {
        key
        for key, length in shortest.items()
        if length <= limits[key[0]] and length - prices[list(key[1])].sum() - least[key[0]] <= 4.0
    }
    pool = enumerate_routes(groups, prices, 4.0, limits, 10_000)
    listed = {
        (int(i), frozenset(t for t in tasks.tolist() if t >= 0)) for i, tasks in zip(pool.drones, pool.tasks, strict=True)
    }
    assert listed <= set(shortest) and len(listed) == len(pool)
    # ng-routes may earn a drone more than routes can, and then the list holds less; six tasks fit one neighbourhood.
    assert listed == expected and len(expected) > 3
    for i, tasks, cost in zip(pool.drones, pool.tasks, pool.costs, strict=True):
        order = [task for task in tasks.tolist() if task >= 0]
        assert cost == pytest.approx(travel.route_length(i, order) - travel.start_end[i])
    assert enumerate_routes(groups, prices, 4.0, limits, len(pool) - 1) is None


def test_half_routes_over_three_tasks_break_a_subset_row_cut():
    tasks = np.array([[0, 1], [1, 2], [0, 2], [3, -1]])
    found = violated_cuts(tasks, np.arange(3), np.full(3, 0.5), np.ones(4), np.full(3, 2.0), 10)
    rows = found.members[np.isfinite(found.upper)]
    assert rows.tolist() == [[True, True, True, False]] and found.upper[np.isfinite(found.upper)].tolist() == [1.0]


def test_too_few_routes_for_a_load_break_a_capacity_cut():
    # Three tasks by one and a half routes of at most two tasks each need two routes.
    tasks = np.array([[0, 1], [1, 2], [0, 2]])
    found = violated_cuts(tasks, np.arange(3), np.full(3, 0.5), np.ones(3), np.full(3, 2.0), 10)
    assert (found.lower == 2.0).any()
    whole = violated_cuts(np.array([[0, 1], [2, -1]]), np.arange(2), np.ones(2), np.ones(3), np.full(3, 2.0), 10)
    assert len(whole.lower) == 0


def test_a_solver_whose_choice_breaks_a_rule_is_not_believed(monkeypatch):
    scene, travel = instance(seed=2)
    honest = HighsProgram.solve_linear

    def liar(program, time_limit_s):
        solution = honest(program, time_limit_s)
        return replace(solution, values=None if solution.values is None else np.zeros_like(solution.values))

    monkeypatch.setattr(HighsProgram, "solve_linear", liar)
    monkeypatch.setattr(exact, "search", lambda *_, **__: ((),) * scene.num_drones)
    with pytest.raises(SolverFailed, match="leaves a task out"):
        solve_exact(scene, travel)


def test_the_result_does_not_depend_on_the_seed():
    scene, travel = instance(seed=5)
    assert len({round(solve_exact(scene, travel, seed=seed).proven, 6) for seed in range(3)}) == 1


def test_a_warm_start_with_a_broken_rule_does_no_harm():
    scene, travel = instance(seed=1)
    crowded = Bundles((tuple(range(14)), (), (), ()))
    assert solve_exact(scene, travel, warm_start=crowded).proven == pytest.approx(solve_exact(scene, travel).proven)
