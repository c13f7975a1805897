"""Voxels are joined to boxes that fill the same space; what is certified is the scene's own."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from flockopt import Box, Scene, Sphere, certify, generate, plan
from flockopt.geometry.distances import distances
from flockopt.scene.merging import merged_obstacles, with_merged_obstacles
from flockopt.scene.parts import obstacle_table
from tests.voxels import voxel_scene


def grid(shape, side=0.1, *, yaw=0.0, at=(0.0, 0.0, 0.0)):
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    cells = (np.argwhere(np.ones(shape)) + 0.5) * side
    return tuple(Box(f"v{index}", tuple((turn @ cell + at).tolist()), (side,) * 3, yaw) for index, cell in enumerate(cells))


@pytest.mark.parametrize("yaw", [0.0, 0.3, -2.0])
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (4999.7, -3.3, 0.05)])
def test_a_block_of_voxels_is_one_box(yaw, at):
    (block,) = merged_obstacles(grid((3, 4, 5), yaw=yaw, at=at))
    assert block.id == "v0"
    assert block.yaw == yaw
    assert block.size == pytest.approx((0.3, 0.4, 0.5), abs=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_distances_stay_the_same(seed):
    rng = np.random.default_rng(seed)
    filled = rng.random((12, 12, 6)) < 0.7
    cells = (np.argwhere(filled) + 0.5) * 0.1
    boxes = tuple(Box(f"v{k}", tuple(cell.tolist()), (0.1,) * 3) for k, cell in enumerate(cells))
    merged = merged_obstacles(boxes)
    assert len(merged) < len(boxes) / 2
    points = rng.uniform(-1.0, 2.0, (500, 3))
    before, after = (distances(obstacle_table(part), points).min(axis=1) for part in (boxes, merged))
    outside = before > 1e-6
    assert np.allclose(before[outside], after[outside], atol=1e-9)
    assert (after[~outside] <= 1e-6).all()
    assert sum(np.prod(box.size) for box in merged) == pytest.approx(len(boxes) * 1e-3)


def test_boxes_that_stand_twice_or_reach_into_each_other_are_one():
    first = Box("a", (0, 0, 0), (2, 1, 1))
    boxes = (first, dataclasses.replace(first, id="b"), Box("c", (1.5, 0, 0), (2, 1, 1)), Box("d", (3, 0, 0), (1, 1, 1)))
    (joined,) = merged_obstacles(boxes)
    assert joined == Box("a", (1.25, 0, 0), (4.5, 1, 1))


def test_what_does_not_fit_together_stays_as_it_is():
    apart = (
        Box("a", (0, 0, 0), (1, 1, 1)), Box("gap", (1.01, 0, 0), (1, 1, 1)), Box("taller", (0, 1, 0), (1, 1, 2)),
        Box("turned", (0, -1, 0), (1, 1, 1), 0.1), Sphere("ball", (3, 3, 3), 1.0),
    )  # fmt: skip
    assert merged_obstacles(apart) is apart


def test_merging_what_is_merged_changes_nothing():
    merged = merged_obstacles(voxel_scene(0).obstacles)
    assert merged_obstacles(merged) == merged


@pytest.mark.parametrize("family", ["forest", "corridor", "warehouse", "rooms", "city"])
def test_scenes_with_few_obstacles_are_planned_as_they_are(family):
    scene = generate(family, drones=4, tasks=8, seed=0)
    assert with_merged_obstacles(scene) is scene


def test_thousands_of_voxels_are_planned_and_certified_against_each_of_them():
    scene: Scene = voxel_scene(0)
    assert len(scene.obstacles) > 5000
    assert len(with_merged_obstacles(scene).obstacles) < 300
    made = plan(scene, planner="classical")
    assert made.status == "certified"
    assert made.scene_sha256 == scene.sha256
    assert made.certificate["clearance"].obstacle in {box.id for box in scene.obstacles}
    assert certify(scene, made).certified
    smaller = scene.replace(obstacles=with_merged_obstacles(scene).obstacles)
    same = certify(smaller, dataclasses.replace(made, scene_sha256=smaller.sha256))
    assert same["clearance"].margin == pytest.approx(made.certificate["clearance"].margin, abs=1e-6)
