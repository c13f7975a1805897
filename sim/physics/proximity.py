"""Whether anything could touch in the next moment, by closed-form distances, compiled."""

from __future__ import annotations

import math

from flockopt.batches.compiled import compiled_lazily
from flockopt.geometry.kernels import point_distance
from flockopt.records.arrays import FloatArray

__all__ = ["within_reach"]


@compiled_lazily(error_model="numpy")
def within_reach(
    table: FloatArray,
    boxes: FloatArray,
    radii: FloatArray,
    states: FloatArray,
    drive: FloatArray,
    step_s: float,
    reach_m: float,
) -> bool:
    """Whether any drone has come nearer than ``reach_m`` to an obstacle or another drone in a step.

    Args:
        table: (K, 9) obstacles, see `flockopt.geometry.distances.OBSTACLE_COLUMNS`.
        boxes: (K, 2, 3) m, their bounding boxes.
        radii: (N,) m, of the drones' balls.
        states: (N, 17) at the end of the step; the first three columns are positions, metres.
        drive: (N, 3) m/s, mean velocity over the step.
        step_s: The step, s.
        reach_m: Between surfaces.
    """
    for i in range(states.shape[0]):
        x, y, z = states[i, 0], states[i, 1], states[i, 2]
        u, v, w = drive[i, 0], drive[i, 1], drive[i, 2]
        reach = radii[i] + reach_m + step_s * math.sqrt(u * u + v * v + w * w)
        for k in range(table.shape[0]):
            if not boxes[k, 0, 0] - reach < x < boxes[k, 1, 0] + reach:
                continue
            near_y = boxes[k, 0, 1] - reach < y < boxes[k, 1, 1] + reach
            if near_y and point_distance(table[k], x, y, z) < reach:
                return True
        for j in range(i):
            a, b, c = states[j, 0] - x, states[j, 1] - y, states[j, 2] - z
            u, v, w = drive[j, 0], drive[j, 1], drive[j, 2]
            both = reach + radii[j] + step_s * math.sqrt(u * u + v * v + w * w)
            if a * a + b * b + c * c < both * both:
                return True
    return False
