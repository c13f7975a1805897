"""The PettingZoo view of the allocation environment."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import SettingsError
from flockopt.travel.travel import straight_travel
from tests.instances import random_scene

pytest.importorskip("pettingzoo", reason="PettingZoo comes with the extra 'learned'")
pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from pettingzoo.test import parallel_api_test

from learned.teacher.parallel_env import AllocationEnv
from learned.teacher.problems import Problems, random_problems


class Reluctant(AllocationEnv):
    """An environment in which drones that are done stay."""

    def step(self, actions):
        before = list(self.agents)
        result = super().step(actions)
        self.agents = before
        return result


def test_pettingzoo_is_content_with_ours_and_not_with_a_faulty_one():
    parallel_api_test(AllocationEnv(3, 5), num_cycles=60)  # raises what it finds
    with pytest.raises(AssertionError):
        parallel_api_test(Reluctant(3, 5), num_cycles=60)


def test_rewards_add_up_to_the_travel_of_a_scene():
    scene = random_scene(np.random.default_rng(0), drones=3, tasks=6, capacity=2)
    travel = straight_travel(scene)
    env = AllocationEnv(3, 6, draw=lambda generator: Problems.of([scene], [travel]))
    seen, _ = env.reset(seed=0)
    routes, total = {agent: [] for agent in env.possible_agents}, 0.0
    while env.agents:  # one drone after the other, so that nobody loses a task
        turn = next(agent for agent in env.agents if seen[agent]["action_mask"][:6].any())
        task = int(np.flatnonzero(seen[turn]["action_mask"][:6])[0])
        seen, rewards, over, cut, _ = env.step({agent: task if agent == turn else 6 for agent in env.possible_agents})
        routes[turn].append(task)
        total -= rewards[turn]
    assert all(over.values()) and not any(cut.values())
    scale = float(Problems.of([scene], [travel]).scale)
    assert total * scale * 6 == pytest.approx(travel.total(list(routes.values())), rel=1e-4)


def test_an_episode_of_forbidden_actions_is_cut_off():
    env = AllocationEnv(1, 2)
    env.reset(seed=0)
    steps = 0
    while env.agents:
        _, _, over, cut, _ = env.step({"drone_0": 2})
        steps += 1
    assert steps == 8
    assert all(cut.values()) and not any(over.values())


def test_seeds_give_the_same_episode_again():
    env = AllocationEnv(2, 3)
    first, again = (env.reset(seed=4)[0]["drone_1"]["tasks"] for _ in range(2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, env.reset()[0]["drone_1"]["tasks"])


def test_problems_of_another_size_are_refused():
    env = AllocationEnv(2, 3, draw=lambda generator: random_problems(1, 2, 4, generator))
    with pytest.raises(SettingsError, match="draw made 1 x 2 drones x 4 tasks"):
        env.reset()
    with pytest.raises(SettingsError, match="num_drones is 0"):
        AllocationEnv(0, 3)
