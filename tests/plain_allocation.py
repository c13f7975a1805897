"""The allocation environment once more, slow and plain: loops over drones and tasks, from scene and travel, in metres."""

from __future__ import annotations

import math


class PlainEnvironment:
    """One fleet that chooses tasks step by step, by the rules in `learned.teacher.environment`."""

    def __init__(self, scene, travel, *, slots=None, step_cost=0.0):
        self.scene, self.travel, self.step_cost = scene, travel, step_cost
        self.scale = plain_scale(scene, travel)
        self.routes = [[] for _ in scene.drones]
        self.taken = [0] * scene.num_drones
        self.slots = scene.num_tasks if slots is None else slots
        self.is_stalled = False

    def cost(self, drone, task):
        """What appending a task adds to a drone's route, metres."""
        before, after = self.routes[drone], [*self.routes[drone], task]
        return self.travel.route_length(drone, after) - self.travel.route_length(drone, before)

    def may_take(self, drone, task):
        scene = self.scene
        if any(task in route for route in self.routes):
            return False
        carried = sum(scene.tasks[other].demand for other in self.routes[drone])
        if carried + scene.tasks[task].demand > scene.drones[drone].capacity or self.taken[drone] >= self.slots:
            return False
        length = self.travel.route_length(drone, [*self.routes[drone], task])
        limit = scene.drones[drone].max_distance
        return math.isfinite(length) and (limit is None or length <= limit)

    def allowed(self):
        """(N, M + 1) whether each drone may name each task, or idle."""
        rows = []
        for drone in range(self.scene.num_drones):
            tasks = [self.may_take(drone, task) for task in range(self.scene.num_tasks)]
            rows.append([*tasks, not (self.is_stalled and any(tasks))])
        return rows

    @property
    def is_over(self):
        return not any(self.may_take(i, j) for i in range(self.scene.num_drones) for j in range(self.scene.num_tasks))

    def step(self, actions):
        """Take tasks; who took which, and the team's reward."""
        over = self.is_over
        taken = [-1] * self.scene.num_drones
        for task in range(self.scene.num_tasks):
            claims = [(self.cost(drone, task), drone) for drone, action in enumerate(actions) if action == task]
            if claims:
                taken[min(claims)[1]] = task
        paid = 0.0
        for drone, task in enumerate(taken):
            if task >= 0:
                paid += self.cost(drone, task)
                self.taken[drone] += 1
        for drone, task in enumerate(taken):
            if task >= 0:
                self.routes[drone].append(task)
        self.is_stalled = all(task < 0 for task in taken)
        return taken, -paid / self.scale / self.scene.num_tasks - (0.0 if over else self.step_cost)


def plain_scale(scene, travel):
    """Mean over tasks of the way to the nearest other place."""
    nearest, legs = [], []
    for task in range(scene.num_tasks):
        ways = [travel.start_task[drone, task] for drone in range(scene.num_drones)]
        ways += [travel.task_task[:, other, task].min() for other in range(scene.num_tasks) if other != task]
        legs += [way for way in ways if math.isfinite(way)]
        if math.isfinite(min(ways)):
            nearest.append(min(ways))
    return max(sum(nearest) / len(nearest), 1e-3 * sum(legs) / len(legs)) if legs else 1.0
