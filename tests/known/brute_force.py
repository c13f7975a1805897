"""The optimum by trying everything: subsets of tasks by drone, orders within each. For seven tasks or fewer."""

from __future__ import annotations

import math

from flockopt.scene import Scene
from flockopt.travel import Travel


def least_travel(scene: Scene, travel: Travel) -> float:
    """Least travel of an allocation that serves all tasks within every limit; infinite where there is none."""
    everything = (1 << scene.num_tasks) - 1
    served = {0: 0.0}  # least travel of the drones so far, by the tasks they serve
    for drone in range(scene.num_drones):
        lengths = _route_lengths(scene, travel, drone)
        following: dict[int, float] = {}
        for before, cost in served.items():
            free = everything & ~before
            subset = free
            while True:
                total = cost + lengths.get(subset, math.inf)
                if total < following.get(before | subset, math.inf):
                    following[before | subset] = total
                if subset == 0:
                    break
                subset = (subset - 1) & free
        served = following
    return served.get(everything, math.inf)


def _route_lengths(scene: Scene, travel: Travel, drone: int) -> dict[int, float]:
    """The shortest route of a drone for every set of tasks (as bits) that it may serve."""
    record = scene.drones[drone]
    longest = math.inf if record.max_distance is None else record.max_distance + 1e-9
    between = travel.task_task[travel.drone_class[drone]].tolist()
    starts, ends = travel.start_task[drone].tolist(), travel.task_end[drone].tolist()
    num = scene.num_tasks
    ending = {(1 << task, task): starts[task] for task in range(num)}  # least length by set and last task
    best = {0: float(travel.start_end[drone])}
    for tasks in range(1, 1 << num):
        if sum(scene.tasks[task].demand for task in range(num) if tasks >> task & 1) > record.capacity:
            continue
        for last in range(num):
            if not tasks >> last & 1:
                continue
            length = ending[tasks, last]
            best[tasks] = min(best.get(tasks, math.inf), length + ends[last])
            for after in range(num):
                if not tasks >> after & 1:
                    key = (tasks | 1 << after, after)
                    ending[key] = min(ending.get(key, math.inf), length + between[last][after])
    return {tasks: length for tasks, length in best.items() if length <= longest}
