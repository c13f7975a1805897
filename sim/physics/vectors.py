"""Vectors and rotations as tuples of floats: compiled, they live in registers and cost no memory.

A rotation is its three axes in the world frame (the columns of its matrix); quaternions are (x, y, z, w), as in PyBullet.
"""

from __future__ import annotations

import math
from typing import TypeAlias

from flockopt.batches.compiled import compiled_lazily

__all__ = [
    "Axes", "Quaternion", "Vector", "axes_of", "cross", "dot", "minus", "norm", "plus", "rotated", "times", "to_body",
    "to_world", "turn_between",
]  # fmt: skip

Vector: TypeAlias = tuple[float, float, float]
Axes: TypeAlias = tuple[Vector, Vector, Vector]
Quaternion: TypeAlias = tuple[float, float, float, float]

#: Below this angle, in radians, the sine of half of it is half of it to rounding.
SMALL_ANGLE = 1e-8


@compiled_lazily(error_model="numpy")
def plus(a: Vector, b: Vector) -> Vector:
    """The sum a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled_lazily(error_model="numpy")
def minus(a: Vector, b: Vector) -> Vector:
    """The difference a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled_lazily(error_model="numpy")
def times(factor: float, a: Vector) -> Vector:
    """The vector scaled."""
    return factor * a[0], factor * a[1], factor * a[2]


@compiled_lazily(error_model="numpy")
def dot(a: Vector, b: Vector) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled_lazily(error_model="numpy")
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled_lazily(error_model="numpy")
def norm(a: Vector) -> float:
    """Euclidean length."""
    return math.sqrt(dot(a, a))


@compiled_lazily(error_model="numpy")
def axes_of(q: Quaternion) -> Axes:
    """The body's axes in the world frame, from a unit quaternion."""
    x, y, z, w = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@compiled_lazily(error_model="numpy")
def to_body(axes: Axes, world: Vector) -> Vector:
    """A vector of the world frame in the body's."""
    return dot(axes[0], world), dot(axes[1], world), dot(axes[2], world)


@compiled_lazily(error_model="numpy")
def to_world(axes: Axes, body: Vector) -> Vector:
    """A vector of the body's frame in the world's."""
    return plus(plus(times(body[0], axes[0]), times(body[1], axes[1])), times(body[2], axes[2]))


@compiled_lazily(error_model="numpy")
def rotated(q: Quaternion, turn: Vector) -> Quaternion:
    """The attitude after a turn in the body's frame, given as axis times angle (radians)."""
    angle = norm(turn)
    half = 0.5 if angle < SMALL_ANGLE else math.sin(0.5 * angle) / angle
    (a, b, c), d = times(half, turn), math.cos(0.5 * angle)
    x, y, z, w = q
    x, y, z, w = (
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
        w * d - x * a - y * b - z * c,
    )
    size = math.sqrt(x * x + y * y + z * z + w * w)
    return x / size, y / size, z / size, w / size


@compiled_lazily(error_model="numpy")
def turn_between(before: Quaternion, after: Quaternion) -> Vector:
    """The turn from one attitude to another in the world frame, axis times angle (radians)."""
    a, b, c, d = -before[0], -before[1], -before[2], before[3]
    x, y, z, w = after
    turn = (w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a, w * c + x * b - y * a + z * d)
    scalar = w * d - x * a - y * b - z * c
    if scalar < 0.0:
        turn, scalar = times(-1.0, turn), -scalar
    size = norm(turn)
    factor = 2.0 if size < SMALL_ANGLE else 2.0 * math.atan2(size, scalar) / size
    return times(factor, turn)
