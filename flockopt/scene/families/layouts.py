"""Where the obstacles of each family stand.

Every layout leaves one connected space by construction, with passages at least a door wide, so that no start
or task is ever walled in. Lengths are multiples of the door the drones need (`FamilySettings.door`, 1 m for a
Crazyflie), so that big drones get the same scenes at their own scale.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flockopt.errors import SettingsError
from flockopt.scene import Box, Cylinder, Obstacle, Point
from flockopt.scene.families.settings import FamilySettings
from flockopt.scene.families.walls import Block, Opening, Wall, numbered

__all__ = ["FAMILIES", "Ground", "Layout"]

#: Throws in a row of a tree or building, before the family says that they do not fit.
MAX_THROWS = 1000

#: What throws that do not fit, one for each obstacle asked for, leave of the range of sizes.
SHRINKING = 0.95

WALL_THICKNESS_DOORS = 0.2


@dataclass(frozen=True)
class Ground:
    """The empty space a layout fills."""

    size: Point
    settings: FamilySettings

    @property
    def door(self) -> float:
        """The unit of length, metres."""
        return self.settings.door

    def count(self, per_default_space: int) -> int:
        """How many obstacles: as set, or as dense as this many in a space of 20 x 20 doors, less a rim of one."""
        if self.settings.obstacles is not None:
            return self.settings.obstacles
        inner = [side / self.door - 2 for side in self.size[:2]]
        return max(1, int(per_default_space * inner[0] * inner[1] / 18**2 + 1e-9))


@dataclass(frozen=True)
class Layout:
    """Obstacles, and the gates between them where nobody may hover: openings with some room on both sides."""

    obstacles: tuple[Obstacle, ...]
    gates: tuple[Box, ...] = ()


def forest(ground: Ground, rng: np.random.Generator) -> Layout:
    """Tree trunks: upright cylinders, three in four of full height."""
    height = ground.size[2]
    trees: list[Obstacle] = []
    for index, (x, y, radius, _) in enumerate(_scattered(ground, rng, ground.count(8), (0.3, 0.9), is_round=True)):
        top = height if rng.random() < 0.75 else round(height * rng.uniform(0.4, 0.75), 2)
        trees.append(Cylinder(f"tree-{index}", (x, y, top / 2), radius, top))
    return Layout(tuple(trees))


def city(ground: Ground, rng: np.random.Generator) -> Layout:
    """Buildings: boxes turned any way, of many heights, one in six up to the ceiling."""
    height = ground.size[2]
    buildings: list[Obstacle] = []
    for index, (x, y, *halves) in enumerate(_scattered(ground, rng, ground.count(12), (0.5, 1.4), is_round=False)):
        top = height if rng.random() < 1 / 6 else round(height * rng.uniform(0.15, 0.85), 2)
        yaw = round(rng.uniform(-math.pi / 2, math.pi / 2), 4)
        buildings.append(Box(f"building-{index}", (x, y, top / 2), (2 * halves[0], 2 * halves[1], top), yaw))
    return Layout(tuple(buildings))


def _scattered(
    ground: Ground, rng: np.random.Generator, count: int, half_sizes: tuple[float, float], *, is_round: bool
) -> list[tuple[float, float, float, float]]:
    """Footprints that leave a door between each other and towards the sides: rows of x, y, half_x, half_y.

    Footprints apart from each other and from the sides cannot close off any ground. What does not fit is thrown
    again, place and size, and the size ever smaller.
    """
    placed: list[tuple[float, float, float, float]] = []
    reaches: list[float] = []
    least, largest = half_sizes
    shrinking, throws = SHRINKING ** (1 / max(count, 1)), 0
    while len(placed) < count and throws < MAX_THROWS:
        half_x, half_y = np.round(ground.door * rng.uniform(least, largest, 2), 3)
        reach = half_x if is_round else math.hypot(half_x, half_y)
        x, y = (round(float(side * share), 3) for side, share in zip(ground.size[:2], rng.random(2), strict=True))
        to_sides = min(x, y, ground.size[0] - x, ground.size[1] - y) - reach
        gaps = [math.hypot(x - other[0], y - other[1]) - far - reach for other, far in zip(placed, reaches, strict=True)]
        if min([to_sides, *gaps]) < ground.door:
            throws, largest = throws + 1, least + shrinking * (largest - least)
        else:
            throws = 0
            placed.append((x, y, float(half_x), float(half_y)))
            reaches.append(reach)
    if len(placed) < count:
        found = f"is {count}, of which only {len(placed)} fit in {ground.size[0]:g} x {ground.size[1]:g} m"
        raise SettingsError("obstacles", found, "obstacles leave a door between each other", "ask for fewer or enlarge size")
    return placed


def corridor(ground: Ground, rng: np.random.Generator) -> Layout:
    """Aisles along x between full-height walls with gaps, each aisle partitioned by stubs that leave a passage."""
    length, width, height = ground.size
    bays = max(1, int(length / (5 * ground.door)))
    slot = length / (2 * bays)  # gaps go to even slots, stubs to odd ones, so that neither blocks the other
    aisles = max(2, round(width / (4 * ground.door)))
    aisle = width / aisles
    walls = []
    for row in range(1, aisles):
        openings = [_gap(ground, rng, 2 * slot * bay, slot) for bay in rng.permutation(bays)[: max(1, bays // 2)]]
        walls.append(_wall(ground, 0, row * aisle, 0.0, length, openings))
    for row, bay in itertools.product(range(aisles), range(bays)):
        gap = ground.door * rng.uniform(1.2, 1.6)
        at_low_side, stands = rng.random() < 0.5, rng.random() < 0.5
        if stands:
            edge = row * aisle + (gap / 2 if at_low_side else aisle - gap / 2)
            opening = Opening(edge, gap, 0.0, height)
            walls.append(_wall(ground, 1, (2 * bay + 1.5) * slot, row * aisle, (row + 1) * aisle, [opening]))
    return _walled(ground, walls)


def _gap(ground: Ground, rng: np.random.Generator, low: float, slot: float) -> Opening:
    """A full-height gap somewhere in the slot that begins at ``low``."""
    gap = ground.door * rng.uniform(1.0, 1.6)
    return Opening(low + slot / 2 + rng.uniform(-0.4, 0.4) * (slot - gap), gap, 0.0, ground.size[2])


def rooms(ground: Ground, rng: np.random.Generator) -> Layout:
    """A grid of rooms; doors join them all (a random spanning tree), more doors and windows close loops."""
    length, width, _ = ground.size
    columns, rows = (max(2, round(side / (6.5 * ground.door))) for side in (length, width))
    joined = _openings(ground, rng, columns, rows)
    walls = [
        _wall(ground, 1, column * length / columns, 0.0, width, [joined[1, column, row] for row in range(rows)])
        for column in range(1, columns)
    ]
    walls += [
        _wall(ground, 0, row * width / rows, 0.0, length, [joined[0, column, row] for column in range(columns)])
        for row in range(1, rows)
    ]
    return _walled(ground, walls)


def _openings(ground: Ground, rng: np.random.Generator, columns: int, rows: int) -> dict[tuple[int, int, int], Opening | None]:
    """What is between neighbouring rooms, by wall axis and the column and row of the farther room."""
    borders = [(1, column, row) for column in range(1, columns) for row in range(rows)]
    borders += [(0, column, row) for column in range(columns) for row in range(1, rows)]
    region = {place: place for place in itertools.product(range(columns), range(rows))}
    result: dict[tuple[int, int, int], Opening | None] = {}
    for index in rng.permutation(len(borders)):
        axis, column, row = borders[index]
        here, there = region[column, row], region[(column - 1, row) if axis else (column, row - 1)]
        kind = "door" if here != there else str(rng.choice(["door", "window", "window", "solid", "solid"]))
        for place, label in region.items():
            region[place] = here if label == there else label
        low, side = (row, ground.size[1] / rows) if axis else (column, ground.size[0] / columns)
        result[axis, column, row] = _opening(ground, rng, kind, low * side, side)
    return result


def _opening(ground: Ground, rng: np.random.Generator, kind: str, low: float, side: float) -> Opening | None:
    """A door, a window or nothing in the stretch of wall that begins at ``low`` and is ``side`` metres long."""
    door, window = ground.door, ground.settings.window
    if kind == "solid":
        return None
    if kind == "door":
        wide, bottom, high = door * rng.uniform(1.0, 1.4), 0.0, door * rng.uniform(2.0, 2.4)
    else:
        wide, bottom, high = window * rng.uniform(1.0, 1.6), door * rng.uniform(0.8, 1.4), window * rng.uniform(1.0, 1.4)
    # Half a door of wall stays on both sides, so that the walls that cross here do not narrow the opening.
    reach = (side - door - wide) / 2
    return Opening(low + side / 2 + reach * rng.uniform(-1, 1), wide, bottom, bottom + high)


def warehouse(ground: Ground, rng: np.random.Generator) -> Layout:
    """Rows of racks with aisles between; one can fly over every rack and through the middle of some."""
    length, width, height = ground.size
    door = ground.door
    rows, racks = max(1, int((width - door) / (3 * door))), max(1, round(length / (7 * door)))
    cross_aisle, margin = 1.5 * door, 2 * door
    rack = (length - 2 * margin - (racks - 1) * cross_aisle) / racks
    highest = min(3.8 * door, height - 1.2 * door)
    blocks: list[Block] = []
    gates: list[Block] = []
    for row, column in itertools.product(range(rows), range(racks)):
        top, share = rng.uniform(min(2 * door, 0.7 * highest), highest), rng.random()
        x, y = margin + column * (rack + cross_aisle) + rack / 2, (row + 0.5) * width / rows
        if share < 0.1:
            continue
        passage = 1.1 * door
        is_open = share < 0.4 and top >= 2.2 * door
        low_top = rng.uniform(0.4 * door, top - passage - 0.4 * door) if is_open else top
        blocks.append(((x, y, low_top / 2), (rack, door, low_top)))
        if is_open:
            above = low_top + passage
            blocks.append(((x, y, (above + top) / 2), (rack, door, top - above)))
            gates.append(((x, y, low_top + passage / 2), (rack, 2 * door, passage)))
    return Layout(tuple(numbered("rack", blocks)), tuple(numbered("gate", gates)))


def _wall(
    ground: Ground, axis: int, offset: float, low: float, high: float, openings: list[Opening | None] | list[Opening]
) -> Wall:
    present = tuple(opening for opening in openings if opening is not None)
    return Wall(axis, offset, low, high, ground.size[2], WALL_THICKNESS_DOORS * ground.door, present)


def _walled(ground: Ground, walls: list[Wall]) -> Layout:
    pieces = [piece for wall in walls for piece in wall.pieces()]
    gates = [gate for wall in walls for gate in wall.gates(0.5 * ground.door)]
    return Layout(tuple(numbered("wall", pieces)), tuple(numbered("gate", gates)))


#: The families by name.
FAMILIES: dict[str, Callable[[Ground, np.random.Generator], Layout]] = {
    layout.__name__: layout for layout in (forest, corridor, warehouse, rooms, city)
}
