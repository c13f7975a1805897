"""The search's own parts: links that stay whole through every move, matching, neighbours, stopping."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from flockopt.bundles.search import anneal as search_module
from flockopt.bundles.search import construct
from flockopt.bundles.search.anneal import default_iterations, search
from flockopt.bundles.search.construct import build_problem, build_routes
from flockopt.bundles.search.matching import MOST_ROUTES, _match, match_tails, matching_scratch
from flockopt.bundles.search.moves import recreate, ruin
from flockopt.bundles.search.state import (
    NUM_RESTING,
    NUM_TORN,
    NUM_WAITING,
    UNSERVED,
    adopt,
    commit,
    random_index,
    random_unit,
    total_cost,
    undo,
)
from tests.instances import random_instance
from tests.known.brute_force import least_travel

SETTINGS = [
    {"drones": 6, "tasks": 25, "capacity": 5},
    {"drones": 5, "tasks": 25, "capacity": 4},  # too little: some tasks always wait
    {"drones": 4, "tasks": 20, "capacity": [3, 9, 12, 30], "demands": True, "ends": True, "max_distance": 50.0},
]


def begun(settings: dict, seed: int):
    scene, travel = random_instance(np.random.default_rng(seed), **settings)
    problem = build_problem(scene, travel)
    return problem, build_routes(problem, (), np.empty((0, 0)), seed)[0]


def links(problem, routes) -> list[list[int]]:
    """Routes read from their links, after checking everything that is kept beside them."""
    num_tasks, found = len(problem.demand), []
    for drone in range(len(problem.capacity)):
        tasks, node = [], num_tasks + drone
        while (following := int(routes.after[node])) < num_tasks:
            assert routes.before[following] == node
            assert routes.route[following] == drone
            tasks.append(following)
            node = following
        assert following == num_tasks + drone
        assert routes.before[following] == node
        assert routes.size[drone] == len(tasks)
        assert routes.room[drone] == problem.capacity[drone] - problem.demand[tasks].sum() >= 0
        nodes, kind = [num_tasks + drone, *tasks, num_tasks + drone], problem.drone_class[drone]
        length = sum(problem.distance[kind, a, b] for a, b in itertools.pairwise(nodes))
        assert routes.length[drone] == pytest.approx(length, abs=1e-7)
        assert not tasks or length <= problem.longest[drone] + 1e-7
        found.append(tasks)
    waiting = routes.waiting[: routes.counters[NUM_WAITING]].tolist()
    assert sorted([task for tasks in found for task in tasks] + waiting) == list(range(num_tasks))
    assert all(routes.route[task] == UNSERVED for task in waiting)
    resting = {drone for drone, tasks in enumerate(found) if not tasks}
    assert routes.counters[NUM_RESTING] == len(resting)
    for group, first in enumerate(problem.first_member):
        assert set(routes.resting[first : first + routes.num_resting[group]].tolist()) == {
            drone for drone in resting if problem.group[drone] == group
        }
    return found


@pytest.mark.parametrize("settings", SETTINGS)
def test_every_move_tells_its_cost_and_keeps_the_links_whole(settings):
    problem, routes = begun(settings, 1)
    matching, cost = matching_scratch(), total_cost(problem, routes)
    for turn in range(300):
        waited, before = routes.counters[NUM_WAITING], links(problem, routes)
        change = ruin(problem, routes, 6.0)
        links(problem, routes)
        change += recreate(problem, routes, waited, 0.01)
        change += problem.penalty * (routes.counters[NUM_WAITING] - waited)
        links(problem, routes)
        if turn % 2:
            undo(problem, routes)
            assert links(problem, routes) == before
        else:
            commit(routes)
            cost += change
        cost += match_tails(problem, routes, matching)
        links(problem, routes)
        assert cost == pytest.approx(total_cost(problem, routes), abs=1e-5)


def test_without_a_place_near_by_tasks_go_back_to_the_ruined_routes(monkeypatch):
    monkeypatch.setattr(construct, "NUM_NEAR", 0)
    problem, routes = begun({"drones": 6, "tasks": 25, "capacity": 9}, 1)
    for _ in range(50):
        before = links(problem, routes)
        ruin(problem, routes, 6.0)
        torn = routes.torn[: routes.counters[NUM_TORN]].tolist()
        recreate(problem, routes, 0, 0.0)
        commit(routes)
        after = links(problem, routes)
        assert routes.counters[NUM_WAITING] == 0
        assert len(torn) == 1
        assert all(before[drone] in ([], after[drone]) for drone in range(6) if drone not in torn)


def test_few_tasks_are_solved_from_every_seed():
    rng = np.random.default_rng(3)
    for _ in range(5):
        scene, travel = random_instance(rng, drones=3, tasks=6, capacity=4)
        least, problem = least_travel(scene, travel), build_problem(scene, travel)
        found = [travel.total(search(problem, seed=seed)) for seed in range(10)]
        assert found == pytest.approx([least] * 10, abs=1e-9)


def test_matching_never_adds_travel_and_often_saves_some():
    problem, routes = begun(SETTINGS[0], 2)
    matching, saved = matching_scratch(), []
    for _ in range(200):
        ruin(problem, routes, 6.0)
        recreate(problem, routes, 0, 0.5)
        commit(routes)
        saved.append(match_tails(problem, routes, matching))
    assert max(saved) == 0.0
    assert np.count_nonzero(saved) > 20


def test_assignments_are_solved_as_scipy_solves_them():
    rng, matching = np.random.default_rng(0), matching_scratch()
    for _ in range(200):
        count = int(rng.integers(1, MOST_ROUTES + 1))
        matching.cost[:count, :count] = rng.integers(0, 9, (count, count)) * rng.uniform(0.1, 9)
        _match(matching, count)
        rows = matching.row_of[1 : count + 1].astype(int) - 1
        assert sorted(rows) == list(range(count))
        best = linear_sum_assignment(matching.cost[:count, :count])
        assert matching.cost[rows, range(count)].sum() == pytest.approx(matching.cost[:count, :count][best].sum())


def test_adopting_links_restores_the_solution_they_came_from():
    problem, routes = begun(SETTINGS[1], 3)
    after, before = routes.after.copy(), links(problem, routes)
    for _ in range(20):
        waited = routes.counters[NUM_WAITING]
        ruin(problem, routes, 10.0)
        recreate(problem, routes, waited, 0.2)
        commit(routes)
    assert links(problem, routes) != before
    adopt(problem, routes, after)
    assert links(problem, routes) == before


def test_neighbours_are_the_nearest_in_order():
    scene, travel = random_instance(np.random.default_rng(4), drones=4, tasks=30, capacity=9)
    problem = build_problem(scene, travel)
    between = travel.task_task[0] + np.diag(np.full(30, np.inf))
    count = problem.near.shape[1]
    assert count < 30
    assert (problem.near == np.argsort(between, axis=1)[:, :count]).all()


def test_drones_that_are_alike_form_a_group():
    scene, travel = random_instance(np.random.default_rng(4), drones=3, tasks=5, capacity=9)
    fleet = [dataclasses.replace(drone, capacity=scene.drones[0].capacity) for drone in scene.drones]
    twins = scene.replace(drones=fleet)
    travel = type(travel)(travel.start_task[[0, 1, 0]], travel.task_task, travel.task_end, travel.start_end, travel.drone_class)
    problem = build_problem(twins, travel)
    assert problem.group.tolist() == [0, 1, 0]
    assert problem.num_members.tolist() == [2, 1]


def test_random_numbers_cover_their_range_evenly():
    random = np.array([12345], dtype=np.uint64)
    units = np.array([random_unit(random) for _ in range(4000)])
    assert 0.0 < units.min() < 0.01
    assert 0.99 < units.max() <= 1.0
    counts = np.bincount([random_index(random, 7) for _ in range(7000)], minlength=7)
    assert len(counts) == 7
    assert counts.min() > 850


def test_a_time_limit_ends_a_search_that_has_no_other_limit(monkeypatch):
    """Time is what iterations take at 10 microseconds each, so that the test does not depend on the machine."""
    scene, travel = random_instance(np.random.default_rng(5), drones=5, tasks=20, capacity=5)
    anneal, spent = search_module._anneal, [0]

    def counted(*arguments):
        spent[0] += arguments[-1].iterations
        return anneal(*arguments)

    monkeypatch.setattr(search_module, "_anneal", counted)
    monkeypatch.setattr(search_module, "perf_counter", lambda: spent[0] * 1e-5)
    routes = search(build_problem(scene, travel), time_limit_s=0.02)
    assert sorted(task for tasks in routes for task in tasks) == list(range(20))
    assert 2000 <= spent[0] <= 2100


def test_iterations_are_counted_under_a_time_limit_too():
    scene, travel = random_instance(np.random.default_rng(5), drones=5, tasks=20, capacity=5)
    problem = build_problem(scene, travel)
    assert search(problem, time_limit_s=3600.0, iterations=0) == search(problem, iterations=0)
    assert search(problem, time_limit_s=3600.0, iterations=2000) != search(problem, iterations=0)


def test_the_default_grows_with_the_number_of_tasks():
    assert default_iterations(40) == 2 * default_iterations(20) > 0
