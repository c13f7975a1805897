"""The offline execution planner: ordered bundles become legs, and legs become the fleet's samples X* (N, T, 3).

Every drone's samples begin at its start and pass exactly through its tasks in order; the last ones are its end, or its
last task. Which sample a task is depends on the bundle alone (`anchor_places`), so that whoever generates samples for a
bundle knows the places of its anchors before there is a path. Along each leg samples are uniform by arc length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flockopt.bundles import Bundles
from flockopt.errors import SettingsError
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel.travel import stops_of
from learned.paths.ways import LegPlanner

__all__ = ["NUM_SAMPLES", "Rollout", "anchor_places", "anchors_of", "roll_out", "route_legs"]

#: T in the paper.
NUM_SAMPLES = 64


@dataclass(frozen=True, eq=False)
class Rollout:
    """Bundles flown out.

    Attributes:
        samples: (N, T, 3) m; a drone without tasks stays at its start.
        places: For each drone the (K,) samples at which it is at its tasks, rising.
        paths: For each drone the (V, 3) m vertices of its legs, one after another; only the start without any.
        stops: For each drone (V,) which task a vertex is, -1 for none.
    """

    samples: FloatArray
    places: tuple[NDArray[np.int64], ...]
    paths: tuple[FloatArray, ...]
    stops: tuple[NDArray[np.int64], ...]

    @property
    def length(self) -> float:
        """Metres of all legs together."""
        return float(sum(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in self.paths))


def roll_out(scene: Scene, bundles: Bundles, leg: LegPlanner, num_samples: int = NUM_SAMPLES) -> Rollout:
    """Fly bundles out along legs.

    Raises:
        SettingsError: If a leg has no way, or a bundle has more anchors than there are samples.
    """
    samples = np.repeat(scene.starts[:, None], num_samples, axis=1)  # (N, T, 3)
    places, paths, stops = [], [], []
    for drone, route in enumerate(bundles):
        legs = route_legs(scene, drone, route, leg)
        at = anchor_places(anchors_of(scene, drone, route), num_samples)
        for path, first, last in zip(legs, at[:-1], at[1:], strict=True):
            samples[drone, first : last + 1] = _resampled(path, int(last - first))
        places.append(at[1 : len(route) + 1])
        paths.append(np.concatenate([scene.starts[drone : drone + 1], *(path[1:] for path in legs)]))
        stops.append(np.full(len(paths[-1]), -1))
        stops[-1][np.cumsum([len(path) - 1 for path in legs[: len(route)]], dtype=np.int64)] = route
    return Rollout(samples, tuple(places), tuple(paths), tuple(stops))


def route_legs(scene: Scene, drone: int, route: Sequence[int], leg: LegPlanner) -> list[FloatArray]:
    """The legs (V, 3) m of one drone through its tasks and on to its end if it has one; V >= 2.

    Raises:
        SettingsError: If a leg has no way.
    """
    legs = [leg(drone, origin, target) for origin, target in pairwise(stops_of(scene, drone, route))]
    if not all(map(len, legs)):
        rule = f"every leg must have a way for drone {scene.drones[drone].id!r}"
        raise SettingsError(f"bundles[{drone}]", f"is {tuple(route)}", rule, "leave unreachable tasks out")
    return [path if len(path) > 1 else np.repeat(path, 2, axis=0) for path in legs]


def anchors_of(scene: Scene, drone: int, route: Sequence[int]) -> FloatArray:
    """Where a drone must be, in order: its start, its tasks, its end if it has one; (A, 3) m."""
    ends = scene.ends[drone : drone + 1] if scene.drones[drone].end_point is not None else np.empty((0, 3))
    return np.vstack([scene.starts[drone], scene.task_positions[list(route)], ends])


def anchor_places(anchors: FloatArray, num_samples: int) -> NDArray[np.int64]:
    """The sample of every anchor: strictly rising from 0 to ``num_samples - 1``, in proportion to straight distance.

    Args:
        anchors: (A, 3) m, A >= 1, in order.
        num_samples: T, at least A.

    Returns:
        (A,).

    Raises:
        SettingsError: If there are more anchors than samples.
    """
    last = len(anchors) - 1
    if last >= num_samples:
        rule = f"must be at least {last + 1}, one for each anchor of the longest bundle"
        raise SettingsError("num_samples", f"is {num_samples}", rule, "take more samples or shorter bundles")
    flown = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(anchors, axis=0), axis=1))])  # (A,)
    share = flown / flown[-1] if flown[-1] > 0.0 else np.linspace(0.0, 1.0, last + 1)
    rank = np.arange(last + 1)
    rising = np.maximum.accumulate(np.rint(share * (num_samples - 1)).astype(np.int64) - rank)
    places: NDArray[np.int64] = np.clip(rising, 0, num_samples - 1 - last) + rank
    return places


def _resampled(path: FloatArray, intervals: int) -> FloatArray:
    """A polyline at ``intervals + 1`` places, (intervals + 1, 3) m.

    They are uniform by arc length, but that each bend takes the place of the sample nearest to it, as far as the samples
    suffice: chords between samples would cut the corners that a path goes around obstacles by.
    """
    flown = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.linspace(0.0, flown[-1], intervals + 1)
    bends = flown[1:-1]
    if 0 < len(bends) < intervals and flown[-1] > 0.0:
        rank = np.arange(len(bends))
        nearest = np.maximum.accumulate(np.rint(bends / at[1]).astype(np.int64) - rank)
        at[np.clip(nearest, 1, intervals - len(bends)) + rank] = bends
    points = np.stack([np.interp(at, flown, path[:, axis]) for axis in range(3)], axis=-1)
    points[0], points[-1] = path[0], path[-1]
    return points
