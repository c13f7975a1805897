"""When each drone sets off, so that no two meet: a small scheduling model over relative delays.

For two flights only the difference of their delays matters, and on a grid of delays it can be tabulated which
differences make them meet at some moment. Least makespan, then least waiting, under these disjunctions is a
constraint program of a few integers, which OR-Tools' CP-SAT solves to proven optimality. A pair's table is made only
once a schedule lets that pair meet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from numba import types
from numpy.typing import NDArray

from flockopt.batches import cp_sat
from flockopt.batches.compiled import FLOATS_1, FLOATS_3, compiled_for
from flockopt.batches.deadline import NEVER, Deadline
from flockopt.geometry.continuous import first_conflict
from flockopt.records.arrays import FloatArray

__all__ = ["DOING", "meeting_steps", "schedule"]

Curves = Sequence[tuple[FloatArray, FloatArray]]
Axes = Callable[[int, int], FloatArray]

#: What it does, for those who give it a deadline.
DOING = "keeping drones apart"

#: Work CP-SAT may do on one schedule, in its own deterministic seconds: the answer is the same on every machine.
DETERMINISTIC_SECONDS = 2.0

#: How much a second of makespan weighs against a second of one drone's waiting.
MAKESPAN_WEIGHT = 1000


@compiled_for(FLOATS_1, FLOATS_3, FLOATS_1, FLOATS_3, FLOATS_1, types.float64, types.int64)
def meeting_steps(
    bp_a: FloatArray, co_a: FloatArray, bp_b: FloatArray, co_b: FloatArray, axes: FloatArray, step_s: float, most: int
) -> NDArray[np.bool_]:
    """Which differences of delay make two drones meet.

    Args:
        bp_a: (K + 1,) s, breakpoints of the first drone.
        co_a: (K, 3, D), its coefficients.
        bp_b: (L + 1,) s.
        co_b: (L, 3, E).
        axes: (3,) m, half axes of the separation.
        step_s: Seconds of a step.
        most: The largest difference, steps.

    Returns:
        (2 most + 1,), true at ``most + k`` if they meet when the first sets off k steps later than the second.
    """
    result = np.zeros(2 * most + 1, dtype=np.bool_)
    for k in range(-most, most + 1):
        delay_a, delay_b = max(k, 0) * step_s, max(-k, 0) * step_s
        end = max(bp_a[-1] + delay_a, bp_b[-1] + delay_b)
        result[most + k] = first_conflict(bp_a, co_a, delay_a, 1.0, bp_b, co_b, delay_b, 1.0, axes, 0.0, end) >= 0.0
    return result


def schedule(
    curves: Curves, moving: Sequence[bool], axes: Axes, step_s: float, most: int, deadline: Deadline = NEVER
) -> FloatArray | None:
    """Delays, seconds, of least makespan at which no two drones meet.

    Args:
        curves: Breakpoints and coefficients of every drone; one that never moves is parked (`continuous.parked`).
        moving: Which drones may be delayed.
        axes: From two drones to the (3,) m half axes of what they keep between them.
        step_s: Delays are whole numbers of this many seconds.
        most: The longest delay, in steps.
        deadline: When to give up.

    Returns:
        (N,) s, or None if no delays of at most ``most`` steps keep all apart (or none was found in time).

    Raises:
        MissingExtra: If OR-Tools is not installed.
        OutOfTime: If the deadline passes.
    """
    pairs = list(combinations(range(len(curves)), 2))
    tables: dict[tuple[int, int], NDArray[np.bool_]] = {}
    delays = np.zeros(len(curves))
    while True:
        met = [pair for pair in pairs if pair not in tables and _meet(curves, axes, delays, *pair)]
        if not met:
            return delays
        for a, b in met:
            deadline.check(DOING)
            tables[a, b] = meeting_steps(*curves[a], *curves[b], axes(a, b), step_s, most)
        answer = _solve(tables, [curve[0][-1] / step_s for curve in curves], moving, most, deadline)
        deadline.check(DOING)
        if answer is None:
            return None
        delays = answer.astype(np.float64) * step_s


def _meet(curves: Curves, axes: Axes, delays: FloatArray, a: int, b: int) -> bool:
    end = max(curves[a][0][-1] + delays[a], curves[b][0][-1] + delays[b])
    return first_conflict(*curves[a], delays[a], 1.0, *curves[b], delays[b], 1.0, axes(a, b), 0.0, end) >= 0.0


def _solve(
    tables: dict[tuple[int, int], NDArray[np.bool_]],
    durations: Sequence[float],
    moving: Sequence[bool],
    most: int,
    deadline: Deadline,
) -> NDArray[np.int64] | None:
    """Delays in steps that keep every tabulated pair apart, or None."""
    cp_model = cp_sat.cp_model()
    model = cp_model.CpModel()
    delays = [model.new_int_var(0, most if moves else 0, f"delay_{i}") for i, moves in enumerate(moving)]
    makespan = model.new_int_var(0, int(max(durations)) + most + 2, "makespan")
    for delay, duration in zip(delays, durations, strict=True):
        model.add(makespan >= delay + int(np.ceil(duration)))
    for (a, b), meets in tables.items():
        apart = np.flatnonzero(~meets) - most
        model.add_linear_expression_in_domain(delays[a] - delays[b], cp_model.Domain.from_values(apart.tolist()))
    model.minimize(MAKESPAN_WEIGHT * makespan + sum(delays))
    solver, status = cp_sat.solved(model, DETERMINISTIC_SECONDS, deadline)
    if status not in (cp_model.OPTIMAL, cp_model.FEASIBLE):
        return None
    return np.array([solver.value(delay) for delay in delays], dtype=np.int64)
