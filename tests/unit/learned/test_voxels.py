"""Voxel grids: where places are linked, what blocked places do, ends, fleets of several radii, and bad settings."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import SettingsError
from flockopt.scene import Box, Scene
from learned.paths.voxels import VoxelSettings, voxel_oracle
from tests.flights import drone, make_scene


def length(path):
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def test_in_the_open_a_leg_is_its_links_and_a_walk_along_the_axes():
    scene = make_scene([drone(0, (1.25, 1.25, 1.25))], [(4.25, 2.25, 1.75)])
    for connectivity, walk in ((6, 3 + 1 + 0.5), (26, 0.5 * (np.sqrt(3) + np.sqrt(2) + 4))):
        oracle = voxel_oracle(scene, VoxelSettings(connectivity, side=0.5))
        assert oracle.travel.start_task[0, 0] == pytest.approx(walk)
        leg = oracle.leg(0, -1, 0)
        assert length(leg) == pytest.approx(walk)
        assert len(leg) <= 6  # long straight runs: a corner for each axis at most, and the two links


def test_a_place_is_linked_to_the_nearest_centre_it_sees():
    wall = Box("w", (2.3, 5, 1.5), (0.1, 9.9, 3.0))
    scene = make_scene([drone(0, (1.0, 5, 2))], [(2.6, 5.0, 2.0)], (wall,))
    oracle = voxel_oracle(scene, VoxelSettings(26, side=0.5))
    leg = oracle.leg(0, -1, 0)
    # the centre at x = 2.25 is nearer, but within the wall; the one at x = 2.75 is seen
    assert leg[-2][0] == pytest.approx(2.75)


def test_a_task_that_no_free_centre_sees_has_no_way():
    sides = [sign * axis for axis in np.eye(3) for sign in (1, -1)]
    cage = [Box(f"w{i}", tuple(np.add([5, 5, 2], 0.3 * side)), tuple(0.7 - 0.6 * abs(side))) for i, side in enumerate(sides)]
    scene = make_scene([drone(0, (1, 1, 1))], [(5, 5, 2), (8, 8, 2)], tuple(cage))
    oracle = voxel_oracle(scene, VoxelSettings(26, side=1.0))
    assert np.isinf(oracle.travel.start_task[0, 0])
    assert np.isfinite(oracle.travel.start_task[0, 1])
    assert oracle.leg(0, -1, 0).shape == (0, 3)
    assert oracle.leg(0, 1, 0).shape == (0, 3)


def test_voxels_are_halved_where_a_gap_is_too_narrow_for_them():
    gap = 0.6  # free width 0.16 m for a drone that needs 0.22 m on both sides
    walls = (Box("w0", (5, 2.4, 2), (0.2, 4.8, 4)), Box("w1", (5, 4.8 + gap + 2.3, 2), (0.2, 4.6, 4)))
    scene = make_scene([drone(0, (1, 5, 1))], [(9, 5, 1)], walls)
    assert np.isinf(voxel_oracle(scene, VoxelSettings(26, side=0.5)).travel.start_task).all()
    oracle = voxel_oracle(scene)
    assert oracle.side == pytest.approx(0.25)
    assert np.isfinite(oracle.travel.start_task).all()


def test_ends_and_staying_cost_what_they_should():
    scene = make_scene(
        [drone(0, (1.25, 1.25, 1.25), end="start"), drone(1, (6, 6, 1), end=(8, 6, 1)), drone(2, (8, 8, 1))],
        [(3.25, 1.25, 1.25)],
    )
    oracle = voxel_oracle(scene, VoxelSettings(6, side=0.5))
    assert oracle.travel.task_end[0, 0] == pytest.approx(2.0)
    assert oracle.travel.task_end[2, 0] == 0.0
    assert oracle.travel.start_end[0] == pytest.approx(0.0)
    assert oracle.travel.start_end[1] == pytest.approx(length(oracle.leg(1, -1, -2)))
    np.testing.assert_array_equal(oracle.leg(0, -1, -2), [[1.25, 1.25, 1.25]])
    np.testing.assert_array_equal(oracle.leg(2, 0, -2), [[3.25, 1.25, 1.25]])


def test_big_drones_take_the_wide_way_round():
    walls = (Box("w0", (5, 2.0, 2), (0.2, 4.0, 4)), Box("w1", (5, 6.9, 2), (0.2, 4.2, 4)))  # gaps of 0.8 m and 1 m
    scene = make_scene([drone(0, (1, 4.4, 1)), drone(1, (1, 6, 1), radius=0.35)], [(9, 4.4, 1)], walls)
    oracle = voxel_oracle(scene, VoxelSettings(26, side=0.25))
    assert oracle.travel.start_task[0, 0] < 10 < oracle.travel.start_task[1, 0]
    assert oracle.leg(1, -1, 0)[:, 1].max() > 8.9


def test_a_large_scene_gets_larger_voxels(root):
    scene = Scene.load(root / "examples/scenes/rotterdam.json")
    assert VoxelSettings().sides(scene)[0] > 0.6


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"connectivity": 18}, "connectivity is 18; must be 6 or 26"),
        ({"side": 0.0}, "side is 0.0"),
        ({"side": float("nan")}, "side is nan"),
        ({"side": True}, "side is True"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(SettingsError, match=words):
        VoxelSettings(**settings)


def test_too_many_voxels_are_refused():
    scene = make_scene([drone(0, (1, 1, 1))], [(4, 2, 1)])
    with pytest.raises(SettingsError, match=r"side is 0\.01 m, which makes 4e\+08 voxels"):
        voxel_oracle(scene, VoxelSettings(side=0.01))
