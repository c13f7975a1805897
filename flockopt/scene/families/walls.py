"""Walls with openings, cut into boxes."""

from __future__ import annotations

from dataclasses import dataclass

from flockopt.scene import Box, Point

__all__ = ["Opening", "Wall", "numbered"]

Block = tuple[Point, Point]  # centre and full size, metres

#: Pieces thinner than this are left out: an opening that begins where the wall does leaves one of rounding's making.
SLIVER_M = 1e-3


@dataclass(frozen=True)
class Opening:
    """A gap in a wall: where along it, how wide, from which height to which, metres."""

    center: float
    width: float
    bottom: float
    top: float


@dataclass(frozen=True)
class Wall:
    """An upright wall along x (``axis`` 0) or y (1) from ``low`` to ``high``, standing at ``offset`` on the other axis."""

    axis: int
    offset: float
    low: float
    high: float
    height: float
    thickness: float
    openings: tuple[Opening, ...] = ()

    def pieces(self) -> list[Block]:
        """The wall as blocks: full-height ones between openings, low ones below and high ones above them."""
        blocks, reached = [], self.low
        for opening in sorted(self.openings, key=lambda opening: opening.center):
            left, right = opening.center - opening.width / 2, opening.center + opening.width / 2
            blocks.append(self._block(reached, left, 0.0, self.height))
            blocks.append(self._block(left, right, 0.0, opening.bottom))
            blocks.append(self._block(left, right, opening.top, self.height))
            reached = right
        blocks.append(self._block(reached, self.high, 0.0, self.height))
        return [(center, size) for center, size in blocks if min(size) > SLIVER_M]

    def gates(self, depth: float) -> list[Block]:
        """The openings as blocks that reach ``depth`` metres out on both sides."""
        return [
            self._block(o.center - o.width / 2, o.center + o.width / 2, o.bottom, o.top, self.thickness + 2 * depth)
            for o in self.openings
        ]

    def _block(self, low: float, high: float, bottom: float, top: float, thickness: float | None = None) -> Block:
        middle, length, across = (low + high) / 2, high - low, self.thickness if thickness is None else thickness
        center, size = (middle, self.offset), (length, across)
        if self.axis == 1:
            center, size = center[::-1], size[::-1]
        return (*center, (bottom + top) / 2), (*size, top - bottom)


def numbered(name: str, blocks: list[Block]) -> list[Box]:
    """Boxes ``name-0``, ``name-1`` … of these blocks, to the tenth of a millimetre."""
    return [Box(f"{name}-{index}", _rounded(center), _rounded(size)) for index, (center, size) in enumerate(blocks)]


def _rounded(values: Point) -> Point:
    x, y, z = (round(value, 4) for value in values)
    return x, y, z
