"""A second exact method: one circuit of arcs for each drone, solved by CP-SAT on rounded lengths."""

from __future__ import annotations

import math

from ortools.sat.python import cp_model

from flockopt.scene import Scene
from flockopt.travel import Travel

#: CP-SAT counts in integers; a metre is so many of its units.
UNITS_A_METRE = 1_000_000


def least_travel(scene: Scene, travel: Travel) -> float:
    """Least travel of an allocation that serves all tasks, to within the rounding; infinite where there is none."""
    model = cp_model.CpModel()
    serves = [[model.new_bool_var("") for _ in scene.tasks] for _ in scene.drones]
    lengths = [_circuit(model, scene, travel, i, serves[i]) for i in range(scene.num_drones)]
    for j in range(scene.num_tasks):
        model.add_exactly_one(row[j] for row in serves)
    for i, drone in enumerate(scene.drones):
        model.add(sum(task.demand * var for task, var in zip(scene.tasks, serves[i], strict=True)) <= drone.capacity)
        if drone.max_distance is not None:
            model.add(lengths[i] <= math.floor(drone.max_distance * UNITS_A_METRE))
    model.minimize(sum(lengths))
    solver = cp_model.CpSolver()
    solver.parameters.num_workers = 1
    status = solver.solve(model)
    assert status in (cp_model.OPTIMAL, cp_model.INFEASIBLE)
    return solver.objective_value / UNITS_A_METRE if status == cp_model.OPTIMAL else math.inf


def _circuit(model, scene: Scene, travel: Travel, drone: int, serves: list):
    """Units that a drone travels on a circuit over its tasks and one node for its start and end."""
    num = scene.num_tasks
    between = travel.task_task[travel.drone_class[drone]]
    legs = {(num, num): travel.start_end[drone]}
    for j in range(num):
        legs[num, j], legs[j, num] = travel.start_task[drone, j], travel.task_end[drone, j]
        legs.update({(j, k): between[j, k] for k in range(num) if k != j})
    arcs, total = [(j, j, ~serves[j]) for j in range(num)], 0
    for (origin, target), length in legs.items():
        if math.isfinite(length):
            arc = model.new_bool_var("")
            arcs.append((origin, target, arc))
            total += round(length * UNITS_A_METRE) * arc
            if origin == target:  # a circuit may pass by its start only if it is no circuit at all
                model.add_bool_and(~var for var in serves).only_enforce_if(arc)
    model.add_circuit(arcs)
    return total
