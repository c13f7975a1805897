"""The batched environment: equal to a slow, plain one step by step; its rules one by one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from flockopt.travel.travel import straight_travel
from tests.instances import random_scene, with_cut_legs
from tests.plain_allocation import PlainEnvironment

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.teacher.environment import choices, reset, step  # noqa: E402
from learned.teacher.problems import Problems, random_problems  # noqa: E402 - torch may be missing

NUM_EPISODES = 200


def random_fleet(rng):
    """A scene with demands, ends, longest routes and two classes of drones, and travel with some legs cut."""
    drones, tasks = int(rng.integers(1, 6)), int(rng.integers(1, 9))
    capacity = [int(c) for c in rng.integers(0, 6, drones)]
    longest = float(rng.uniform(20, 60)) if rng.uniform() < 0.5 else None
    scene = random_scene(rng, drones=drones, tasks=tasks, capacity=capacity, ends=True, demands=True, max_distance=longest)
    travel = straight_travel(scene)
    matrices = np.concatenate([travel.task_task, 1.3 * travel.task_task])
    classes = rng.integers(0, 2, drones)
    return scene, with_cut_legs(rng, dataclasses.replace(travel, task_task=matrices, drone_class=classes), 0.1)


def random_action(rng, row):
    """One of the allowed actions; the rows of a padded batch are longer than the plain ones."""
    return int(rng.choice(np.flatnonzero(row)))


def test_the_batched_environment_equals_a_plain_one_step_by_step():
    rng = np.random.default_rng(6)
    fleets = [random_fleet(rng) for _ in range(NUM_EPISODES)]
    slots = [None, 1]
    for limit in slots:
        plain = [PlainEnvironment(scene, travel, slots=limit, step_cost=0.01) for scene, travel in fleets]
        problems = Problems.of(*zip(*fleets, strict=True))
        state = reset(problems, limit)
        num_steps = follow(rng, problems, state, plain)
        assert num_steps >= 3
        assert any(twin.routes[0] for twin in plain)


def follow(rng, problems, state, plain):
    """Step both to the end with random actions, comparing all the way."""
    idle, steps = problems.num_tasks, 0
    while True:
        options = choices(problems, state)
        assert options.is_over.tolist() == [twin.is_over for twin in plain]
        if bool(options.is_over.all()):
            return steps
        actions = torch.full(problems.capacity.shape, idle)
        for b, twin in enumerate(plain):
            for drone, row in enumerate(twin.allowed()):
                ours = options.allowed[b, drone].tolist()
                assert [*ours[: len(row) - 1], ours[idle]] == row
                assert not any(ours[len(row) - 1 : idle])
                action = random_action(rng, row)
                actions[b, drone] = idle if action == len(row) - 1 else action
        state, outcome = step(problems, state, options, actions, step_cost=0.01)
        for b, twin in enumerate(plain):
            num_drones, num_tasks = twin.scene.num_drones, twin.scene.num_tasks
            named = [a if a < idle else num_tasks for a in actions[b, :num_drones].tolist()]
            taken, reward = twin.step(named)
            assert outcome.taken[b].tolist() == taken + [-1] * (problems.num_drones - num_drones)
            assert float(outcome.reward[b]) == pytest.approx(reward, rel=1e-4, abs=1e-5)
        steps += 1


def test_rewards_add_up_to_the_fleets_travel():
    rng = np.random.default_rng(1)
    scene = random_scene(rng, drones=3, tasks=8, capacity=4, ends=True)
    travel = straight_travel(scene)
    problems = Problems.of([scene], [travel])
    state, total, routes = reset(problems), 0.0, [[], [], []]
    while not bool((options := choices(problems, state)).is_over):
        actions = torch.tensor([[random_action(rng, row) for row in options.allowed[0].tolist()]])
        state, outcome = step(problems, state, options, actions)
        total -= float(outcome.reward) * float(problems.scale) * 8
        for drone, task in enumerate(outcome.taken[0].tolist()):
            routes[drone] += [task] if task >= 0 else []
    assert travel.start_end.sum() + total == pytest.approx(travel.total(routes), rel=1e-5)


def two_drones_one_task(left, right):
    """Two drones at x = ``left`` and ``right`` and a task at x = 0 beside one far away."""
    problems = random_problems(1, 2, 2, torch.Generator().manual_seed(0))
    return problems.replace(
        start_task=torch.tensor([[[abs(left), 50.0], [abs(right), 50.0]]]), scale=torch.ones(1), capacity=torch.ones(1, 2)
    )


@pytest.mark.parametrize(("left", "right", "winner"), [(-1.0, 2.0, 0), (-2.0, 1.0, 1), (-1.0, 1.0, 0)])
def test_the_cheaper_drone_wins_and_ties_go_to_the_lower_index(left, right, winner):
    problems = two_drones_one_task(left, right)
    state = reset(problems)
    state, outcome = step(problems, state, choices(problems, state), torch.tensor([[0, 0]]))
    assert outcome.taken[0].tolist() == [0 if i == winner else -1 for i in range(2)]
    options = choices(problems, state)
    assert options.allowed[0, 1 - winner].tolist() == [False, True, True]  # the loser keeps its turn
    assert options.allowed[0, winner].tolist() == [False, False, True]


def test_nobody_idles_twice_while_there_is_a_task():
    problems = two_drones_one_task(1.0, 1.0)
    state = reset(problems)
    state, outcome = step(problems, state, choices(problems, state), torch.tensor([[2, 2]]))
    assert outcome.taken.eq(-1).all()
    assert choices(problems, state).allowed[0].tolist() == [[True, True, False]] * 2
    state, _ = step(problems, state, choices(problems, state), torch.tensor([[0, 1]]))
    assert bool(choices(problems, state).is_over)


def test_steps_cost_until_the_episode_ends():
    problems = two_drones_one_task(1.0, 1.0)
    state = reset(problems)
    rewards = []
    for actions in ([2, 2], [0, 1], [2, 2]):
        state, outcome = step(problems, state, choices(problems, state), torch.tensor([actions]), step_cost=0.25)
        rewards.append(float(outcome.reward))
    assert rewards == [-0.25, -(1.0 + 50.0) / 2 - 0.25, 0.0]
