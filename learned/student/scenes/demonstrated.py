"""Demonstrations (`learned.demonstrations`) as examples for the student."""

from __future__ import annotations

import numpy as np

from flockopt.records.arrays import FloatArray, IntArray
from learned.demonstrations.shards import Demonstration
from learned.student.scenes.examples import Example, example, with_ways

__all__ = ["example_of"]


def example_of(demonstration: Demonstration, num_samples: int) -> Example:
    """An example that learns from the demonstrated legs, and from the bundles where they are good ones."""
    base = example(demonstration.scene(), demonstration.teacher_bundles.routes, num_samples)
    ways = zip(demonstration.teacher_paths, demonstration.teacher_stops, strict=True)
    legs = [_legs(path, stops) for path, stops in ways]
    return with_ways(base, legs, teaches_allocation=not demonstration.hard)


def _legs(path: FloatArray, stops: IntArray) -> list[FloatArray]:
    """A drone's vertices (V, 3) split at its tasks."""
    at = np.flatnonzero(stops >= 0)
    return [path[first : last + 1] for first, last in zip([0, *at], at, strict=False)]
