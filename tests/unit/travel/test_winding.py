"""Closed forms for taut strings, against what a plain search finds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from flockopt.geometry.free_space import free_space
from flockopt.scene import Box, Cylinder, Sphere
from flockopt.scene.parts import obstacle_table
from flockopt.travel.bends import make_features
from flockopt.travel.winding import LOOSE, WOUND, heights_along, wound

NEED = 0.3
BOUNDS = (np.zeros(3), np.array([10.0, 10.0, 4.0]))


def features_around(*obstacles):
    return make_features(free_space(obstacle_table(obstacles), NEED, BOUNDS))


def length(*points):
    return float(np.linalg.norm(np.diff(np.array(points), axis=0), axis=1).sum())


def nearest_to(features, place):
    return int(np.linalg.norm(features.position - np.array(place), axis=1).argmin())


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("shape", ["box", "cylinder", "sphere"])
def test_no_bend_nearby_makes_the_string_shorter_and_clear(shape, seed):
    rng = np.random.default_rng(seed)
    obstacle = {
        "box": Box("o", (5, 5, 2), (2, 2, 4)),
        "cylinder": Cylinder("o", (5, 5, 2), 1.0, 4.0),
        "sphere": Sphere("o", (5, 5, 2), 1.0),
    }[shape]  # fmt: skip
    features = features_around(obstacle)
    f = nearest_to(features, (6.4, 6.4, 2.0) if shape == "box" else (5.0, 6.4, 2.0))
    before = np.array([8.5, rng.uniform(3.0, 4.5) if shape == "box" else rng.uniform(4.0, 5.8), rng.uniform(1, 3)])
    after = np.array([rng.uniform(2.5, 4.0), 7.0, 0.0] if shape == "box" else [1.5, rng.uniform(4.0, 5.8), 0.0])
    after[2] = rng.uniform(1, 3)
    bend = np.empty(3)
    assert wound(features, f, before, features.position[f], after, bend) == WOUND
    core, room, along = features.core[f], features.room[f], features.along[f]

    def too_near(at):  # how much nearer than it may be the string comes to the core, by points along it
        points = np.concatenate([np.linspace(before, at, 200), np.linspace(at, after, 200)]) - core
        across = points - np.outer(points @ along, along)
        return max(room - np.linalg.norm(across, axis=1).min(), 0.0)

    assert too_near(bend) < 1e-9
    moved = bend + rng.choice([1e-3, 1e-2, 0.1], (400, 1)) * rng.normal(size=(400, 3))
    clear = [at for at in moved if too_near(at) == 0.0]
    assert len(clear) > 20
    assert min(length(before, at, after) for at in clear) > length(before, bend, after) - 1e-4  # points tell no better


def test_a_string_that_clears_the_core_needs_no_bend():
    features = features_around(Cylinder("o", (5, 5, 2), 1.0, 4.0))
    f = nearest_to(features, (6.4, 6.4, 2.0))
    assert wound(features, f, np.array([9.0, 6.0, 2.0]), features.position[f], np.array([6.0, 9.0, 2.0]), np.empty(3)) == LOOSE


def test_a_ball_between_two_points_on_its_axis_is_passed_on_the_side_where_the_string_is():
    features = features_around(Sphere("o", (5, 5, 2), 1.0))
    f, bend = nearest_to(features, (5.0, 6.4, 2.0)), np.empty(3)
    assert wound(features, f, np.array([1.0, 5.0, 2.0]), features.position[f], np.array([9.0, 5.0, 2.0]), bend) == WOUND
    assert bend[1] > 6.3 and bend[0] == pytest.approx(5.0)


@pytest.mark.parametrize("seed", range(20))
def test_heights_through_gates_are_those_of_the_shortest_string(seed):
    """Upright edges with free stretches of any size, against a plain minimisation."""
    rng = np.random.default_rng(seed)
    features, count = features_around(Box("o", (5, 5, 2), (2, 2, 4))), int(rng.integers(2, 7))
    xs = np.sort(rng.uniform(1, 9, count))
    low = rng.uniform(0.2, 2.5, count)
    high = low + rng.uniform(0.1, 1.5, count)
    position = np.column_stack([xs, np.zeros(count), rng.uniform(low, high)])
    up = np.tile([0.0, 0.0, 1.0], (count, 1)) * rng.choice([-1.0, 1.0], (count, 1))
    ends = np.where(
        up[:, 2:] > 0, np.column_stack([low, high]) - position[:, 2:], position[:, 2:] - np.column_stack([high, low])
    )
    gates = features._replace(
        position=position,
        along=np.ascontiguousarray(up),
        back=np.ascontiguousarray(ends[:, 0]),
        onward=np.ascontiguousarray(ends[:, 1]),
    )
    path = np.vstack([[0.0, 0.0, rng.uniform(0, 4)], position, [10.0, 0.0, rng.uniform(0, 4)]])
    chain, moves = np.arange(-1, count + 1), np.zeros(count + 2)
    heights_along(gates, chain, path, 1, count, True, np.empty((count + 3, 5)), moves)
    moved = path.copy()
    moved[1:-1] += moves[1:-1, None] * up
    assert (moved[1:-1, 2] >= low - 1e-9).all() and (moved[1:-1, 2] <= high + 1e-9).all()

    def whole(heights):
        return length(*np.column_stack([path[:, :2], np.concatenate([path[:1, 2], heights, path[-1:, 2]])]))

    found = minimize(whole, 0.5 * (low + high), bounds=np.column_stack([low, high]), method="L-BFGS-B", options={"ftol": 1e-15})
    assert whole(moved[1:-1, 2]) <= found.fun + 1e-6
    free = moves.copy()
    heights_along(gates, chain, path, 1, count, False, np.empty((count + 3, 5)), free)
    straight = path[0, 2] + (path[-1, 2] - path[0, 2]) * xs / 10.0
    np.testing.assert_allclose(path[1:-1, 2] + free[1:-1] * up[:, 2], straight, atol=1e-9)
    assert math.isfinite(found.fun)
