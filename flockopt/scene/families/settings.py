"""What the scene families can be told, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flockopt.errors import SettingsError
from flockopt.records import checks
from flockopt.scene import Point

__all__ = ["FamilySettings"]

#: Least width of a door and of a window, metres; bigger drones get bigger ones.
LEAST_DOOR_M, LEAST_WINDOW_M = 1.0, 0.9

#: The default space, and the ground it grants each start and task before it grows, in doors and square doors.
DEFAULT_SIZE_DOORS = (20.0, 20.0, 5.0)
AREA_PER_POINT_DOORS2 = 4.0

#: The least space a layout fits in, in doors.
LEAST_SIZE_DOORS = (6.0, 6.0, 3.0)


@dataclass(frozen=True)
class FamilySettings:
    """Settings that all scene families share; the defaults suit a Crazyflie.

    Attributes:
        size: Extent of the space, metres; None takes 20 x 20 x 5 doors and widens it for many starts and tasks.
        radius: Of each drone, metres.
        max_speed: m/s.
        max_acceleration: m/s**2.
        max_jerk: m/s**3.
        clearance: The scene's clearance, metres.
        separation: The scene's separation, metres.
        margin: How much farther from obstacles than radius + clearance starts and tasks stay, metres.
        spare_capacity: What each drone can carry above ceil(tasks / drones).
        obstacles: How many trees or buildings stand in `forest` and `city`; None keeps the family's density.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    size: Point | None = None
    radius: float = 0.12
    max_speed: float = 2.0
    max_acceleration: float = 4.0
    max_jerk: float = 30.0
    clearance: float = 0.1
    separation: float = 0.4
    margin: float = 0.15
    spare_capacity: int = 1
    obstacles: int | None = None

    def __post_init__(self) -> None:
        checks.store(self, checks.number, SettingsError, "radius", "max_speed", "max_acceleration", "max_jerk", above=0.0)
        checks.store(self, checks.number, SettingsError, "clearance", "separation", "margin", least=0.0)
        checks.store(self, checks.integer, SettingsError, "spare_capacity", least=0)
        if self.obstacles is not None:
            checks.store(self, checks.integer, SettingsError, "obstacles", least=0)
        if self.size is not None:
            checks.store(self, checks.point, SettingsError, "size")
            self._check_size(self.size)

    def _check_size(self, size: Point) -> None:
        for axis, (side, doors) in enumerate(zip(size, LEAST_SIZE_DOORS, strict=True)):
            least = doors * self.door
            if not side >= least - 1e-9:
                rule = f"must be >= {least:g} m, {doors:g} times the door these drones need"
                raise SettingsError(f"size[{axis}]", f"is {side:g}", rule, "enlarge it or shrink radius and separation")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> FamilySettings:
        """Settings from keywords; an unknown one is an error that lists the known ones."""
        return checks.from_keys(SettingsError, cls, values)

    @property
    def need(self) -> float:
        """How far a drone's centre stays from any obstacle, metres."""
        return self.radius + self.clearance

    @property
    def spacing(self) -> float:
        """Least distance between any two starts and tasks, metres."""
        return 2 * max(self.separation, self.need)

    @cached_property
    def door(self) -> float:
        """Width of a door, metres: two drones pass in it side by side. Layouts are measured in doors."""
        return max(LEAST_DOOR_M, 1.15 * self._side_by_side)

    @cached_property
    def window(self) -> float:
        """Least width and height of a window, metres."""
        return max(LEAST_WINDOW_M, 1.05 * self._side_by_side)

    @property
    def _side_by_side(self) -> float:
        return 2 * self.need + self.separation

    def space(self, num_points: int) -> Point:
        """The extent for this many starts and tasks: as set, or the default with its area grown to hold them."""
        if self.size is not None:
            return self.size
        length, width, height = (doors * self.door for doors in DEFAULT_SIZE_DOORS)
        needed = AREA_PER_POINT_DOORS2 * self.door**2 * num_points
        growth = max(1.0, math.sqrt(needed / (length * width)))
        # Tenths of a metre, upwards: the files stay readable and the area stays enough.
        return math.ceil(10 * length * growth) / 10, math.ceil(10 * width * growth) / 10, math.ceil(10 * height) / 10
