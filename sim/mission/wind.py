"""What blows: velocities of the air over time, and gusts. Drones feel it through drag, and no controller knows of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.scene import Point
from sim.physics.settings import FlightSettings

__all__ = ["Gust", "Wind", "check_felt", "total_wind"]

#: Velocity of the air, (3,) m/s, at a time of the mission, s.
Wind: TypeAlias = Callable[[float], FloatArray]


@dataclass(frozen=True)
class Gust:
    """The whole air moves for ``duration_s`` from ``time_s`` on, and as fast as ``velocity`` (m/s) in the middle.

    The speed is a discrete gust of one minus cosine, as in MIL-F-8785C, section 3.7.
    """

    time_s: float
    duration_s: float
    velocity: Point

    def __call__(self, time_s: float) -> FloatArray:
        """(3,) m/s, the air's velocity at a time."""
        share = (time_s - self.time_s) / self.duration_s
        strength = 0.5 * (1.0 - math.cos(2.0 * math.pi * share)) if 0.0 < share < 1.0 else 0.0
        return strength * np.array(self.velocity)


def total_wind(winds: Sequence[Wind], time_s: float) -> FloatArray | None:
    """(3,) m/s, the sum of all that blows at a time; None where there has never been anything."""
    return np.sum([blow(time_s) for blow in winds], axis=0) if winds else None


def check_felt(settings: FlightSettings) -> None:
    """Refuse wind where nobody would feel it.

    Raises:
        SettingsError: If the settings leave out drag, through which air is felt.
    """
    if not settings.has_drag:
        raise SettingsError("wind", "blows", "needs has_drag, through which air is felt", "set it or leave out the wind")
