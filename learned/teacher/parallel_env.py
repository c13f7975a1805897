"""The allocation environment as a PettingZoo `ParallelEnv`, for agents from elsewhere.

One fleet at a time, by the same rules, costs and rewards as `learned.teacher.environment`: this is a view of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.teacher.descriptors import DRONE_FEATURES, PAIR_FEATURES, observe
from learned.teacher.environment import Choices, FleetState, choices, reset, step
from learned.teacher.problems import Problems, random_problems

__all__ = ["AllocationEnv"]

#: An episode is cut off after this many steps a task: agents that only try what is not allowed get nowhere.
MOST_STEPS_A_TASK = 4

Observations = dict[str, dict[str, np.ndarray[Any, Any]]]


class AllocationEnv(ParallelEnv):  # type: ignore[misc]  # PettingZoo ships no types
    """Drones that choose tasks together.

    An agent observes ``drone`` (D,), ``tasks`` (M, P), see `learned.teacher.descriptors`, and ``action_mask`` (M + 1,). Its
    action is a task, or M to idle; what is not allowed counts as idling. All agents share the team's reward.

    Args:
        num_drones: N.
        num_tasks: M.
        draw: Makes the problem of an episode, a batch of one with N drones and M tasks; None draws it at random without
            obstacles. For scenes: ``lambda generator: Problems.of([scene], [travel])``.
        step_cost: See `environment.step`.
        seed: Of the episodes, until `reset` is given another.

    Raises:
        SettingsError: If a number is not one that is allowed.
    """

    metadata = {"name": "flockopt_allocation_v0", "render_modes": []}  # noqa: RUF012 - PettingZoo wants it so
    render_mode = None

    def __init__(
        self,
        num_drones: int = 10,
        num_tasks: int = 20,
        *,
        draw: Callable[[torch.Generator], Problems] | None = None,
        step_cost: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.num_drones = checks.integer(SettingsError, "num_drones", num_drones, least=1)
        self.num_tasks = checks.integer(SettingsError, "num_tasks", num_tasks, least=1)
        self.step_cost = checks.number(SettingsError, "step_cost", step_cost, least=0.0)
        self.possible_agents = [f"drone_{index}" for index in range(num_drones)]
        self.agents: list[str] = []
        self._draw = draw or (lambda generator: random_problems(1, num_drones, num_tasks, generator))
        self._generator = torch.Generator().manual_seed(seed)
        tasks = spaces.Box(-np.inf, np.inf, (num_tasks, len(PAIR_FEATURES)), np.float32)
        drone = spaces.Box(-np.inf, np.inf, (len(DRONE_FEATURES),), np.float32)
        mask = spaces.Box(0, 1, (num_tasks + 1,), np.int8)
        self._seen = {
            agent: spaces.Dict({"drone": drone, "tasks": tasks, "action_mask": mask}) for agent in self.possible_agents
        }
        self._action = {agent: spaces.Discrete(num_tasks + 1) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> spaces.Dict:
        """What an agent observes."""
        return self._seen[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """What an agent may do."""
        return self._action[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, dict[str, Any]]:
        """Begin an episode with the next problem, or with the first of another seed; there are no options."""
        if seed is not None:
            self._generator.manual_seed(seed)
        problems = self._draw(self._generator)
        found = (len(problems), problems.num_drones, problems.num_tasks)
        if found != (1, self.num_drones, self.num_tasks):
            rule = f"must make batches of 1 with {self.num_drones} drones and {self.num_tasks} tasks"
            raise SettingsError("draw", f"made {found[0]} x {found[1]} drones x {found[2]} tasks", rule, "change either")
        self._problems, self._steps = problems, 0
        self._last_task = torch.full((1, self.num_drones), -1)
        self._state: FleetState = reset(problems)
        self._options: Choices = choices(problems, self._state)
        self.agents = list(self.possible_agents)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, int]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], dict[str, Any]]:
        """One decision of every agent: observations, rewards, terminations, truncations, and nothing more to tell."""
        named = torch.tensor([[int(actions[agent]) for agent in self.possible_agents]])
        allowed = self._options.allowed.gather(2, named[..., None])[..., 0]
        named = torch.where(allowed, named, self.num_tasks)
        self._state, outcome = step(self._problems, self._state, self._options, named, step_cost=self.step_cost)
        self._last_task, self._steps = outcome.taken, self._steps + 1
        self._options = choices(self._problems, self._state)
        is_over = bool(self._options.is_over)
        is_cut = not is_over and self._steps >= MOST_STEPS_A_TASK * self.num_tasks
        everyone, seen = self.agents, self._observations()
        self.agents = [] if is_over or is_cut else everyone
        return (
            seen,
            dict.fromkeys(everyone, float(outcome.reward)),
            dict.fromkeys(everyone, is_over),
            dict.fromkeys(everyone, is_cut),
            {agent: {} for agent in everyone},
        )

    def _observations(self) -> Observations:
        observed = observe(self._problems, self._state, self._options, self._last_task)
        tasks = torch.zeros(self.num_drones, self.num_tasks, len(PAIR_FEATURES))
        tasks[:, observed.tasks[0]] = observed.pair[0]  # closed tasks are left out of an observation; here they are zeros
        allowed = self._options.allowed[0].to(torch.int8)
        return {
            agent: {
                "drone": observed.drone[0, index].numpy(),
                "tasks": tasks[index].numpy(),
                "action_mask": allowed[index].numpy(),
            }
            for index, agent in enumerate(self.possible_agents)
        }
