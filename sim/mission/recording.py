"""The states of a fleet at every step, in room that grows with the flight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockopt.records.arrays import FloatArray
from sim.physics.fleet import STATE_WIDTH

__all__ = ["Recording"]

#: Steps that are made room for at a time, at least and at most.
LEAST_STEPS, MOST_STEPS = 240, 14400


class Recording:
    """What is known of every drone after each step; NaN from the step on at which it is lost.

    Args:
        state: (N, 17) at the beginning, columns as in `sim.physics.fleet`.
        step_s: Seconds a step.
    """

    def __init__(self, state: FloatArray, step_s: float) -> None:
        self._rows = np.full((1, len(state), STATE_WIDTH), np.nan)
        self._rows[0], self._step_s, self.step = state, step_s, 0

    @property
    def now_s(self) -> float:
        """When the last step ended, seconds."""
        return self.step * self._step_s

    @property
    def times(self) -> FloatArray:
        """(T,) s."""
        return np.arange(self.step + 1, dtype=np.float64) * self._step_s

    @property
    def states(self) -> FloatArray:
        """(T, N, 17)."""
        return self._rows[: self.step + 1]

    def make_room(self, last: int) -> None:
        """Let there be room for all steps up to ``last``."""
        if last >= len(self._rows):
            more = int(np.clip(len(self._rows), LEAST_STEPS, MOST_STEPS))
            rows = np.full((max(last + 1, len(self._rows) + more), *self._rows.shape[1:]), np.nan)
            rows[: self.step + 1] = self.states
            self._rows = rows

    def add(self, state: FloatArray, columns: NDArray[np.int64] | slice) -> None:
        """Take down the next step, for which there is room.

        Args:
            state: (n, 17) of the drones that are left.
            columns: Which of the N they are.
        """
        self.step += 1
        self._rows[self.step, columns] = state

    def since(self, begin_s: float, column: int) -> tuple[FloatArray, FloatArray]:
        """Times (K,) s and positions (K, 3) m of one drone from the last step before a moment on."""
        first = max(0, int(begin_s / self._step_s) - 1)
        return self.times[first:], self.states[first:, column, :3]
