"""Scene families: what was asked for, the same for the same seed, and possible to fly."""

from __future__ import annotations

import dataclasses
import zlib

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial.distance import pdist

from flockopt import Scene, SettingsError, generate
from flockopt.geometry.distances import distances
from flockopt.scene.families.layouts import FAMILIES, Ground
from flockopt.scene.families.settings import FamilySettings
from flockopt.scene.families.walls import Opening, Wall
from flockopt.scene.parts import obstacle_table

SIZES = ((10, 20), (1, 0), (1, 1), (3, 0), (20, 100))
every_family = pytest.mark.parametrize("family", FAMILIES)


def places(scene):
    return np.concatenate([scene.starts, scene.task_positions])


def regions(scene, step=0.2):
    """Labels of the pieces of free space, on a grid, that the starts and tasks are in."""
    counts = (np.array(scene.bounds.upper) / step).astype(int) + 1
    grid = np.stack(np.meshgrid(*[np.arange(count) * step for count in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    free = np.ones(len(grid), dtype=bool)
    for row in scene.obstacle_table:
        reach = np.hypot(np.hypot(row[4], row[5]), row[6]) + 1.0
        near = np.flatnonzero((np.abs(grid - row[1:4]) < reach).all(axis=1))
        free[near] &= distances(row[None], grid[near])[:, 0] >= scene.radii[0] + scene.clearance
    pieces, _ = label(free.reshape(counts))
    cells = np.minimum(np.rint(places(scene) / step).astype(int), counts - 1)
    return set(pieces[tuple(cells.T)].tolist())


@every_family
@pytest.mark.parametrize("size", SIZES)
def test_gives_exactly_what_was_asked_for(family, size):
    for seed in range(8):
        scene = generate(family, drones=size[0], tasks=size[1], seed=seed)
        assert (scene.num_drones, scene.num_tasks) == size
        assert scene.capacities.sum() >= scene.demands.sum()
        assert scene.obstacles


@every_family
def test_same_seed_same_scene(family, tmp_path):
    scene = generate(family, seed=5)
    assert generate(family, seed=5) == scene
    assert generate(family, seed=6).obstacles != scene.obstacles
    scene.save(tmp_path / "scene.json")
    assert Scene.load(tmp_path / "scene.json") == scene


def test_families_with_one_seed_differ():
    starts = {generate(family, seed=1).starts.tobytes() for family in FAMILIES}
    assert len(starts) == len(FAMILIES)


@every_family
def test_starts_and_tasks_leave_room(family):
    for seed in range(8):
        scene = generate(family, drones=10, tasks=40, seed=seed)
        assert pdist(places(scene)).min() >= 2 * scene.separation
        assert distances(scene.obstacle_table, places(scene)).min() >= 0.12 + 0.1 + 0.15


@pytest.mark.parametrize("family", ["corridor", "warehouse", "rooms"])
def test_nobody_hovers_in_an_opening(family):
    settings = FamilySettings()
    num_gates = 0
    for seed in range(8):
        scene = generate(family, drones=10, tasks=60, seed=seed)
        rng = np.random.default_rng([seed, zlib.crc32(family.encode())])
        layout = FAMILIES[family](Ground(scene.bounds.upper, settings), rng)
        assert layout.obstacles == scene.obstacles
        num_gates += len(layout.gates)
        assert distances(obstacle_table(layout.gates), places(scene)).min() >= 0.4 + 0.12
    assert num_gates >= 8


@every_family
@pytest.mark.parametrize("seed", [0, 1])
def test_all_is_one_space(family, seed):
    assert regions(generate(family, drones=10, tasks=40, seed=seed)) == {1}


def test_the_flood_notices_a_sealed_room():
    scene = generate("rooms", seed=0)
    settings = FamilySettings()
    rng = np.random.default_rng([0, zlib.crc32(b"rooms")])
    gates = FAMILIES["rooms"](Ground(scene.bounds.upper, settings), rng).gates
    shut = [dataclasses.replace(gate, id=f"shut-{k}") for k, gate in enumerate(gates)]
    assert len(regions(scene.replace(obstacles=[*scene.obstacles, *shut]))) > 1


@every_family
def test_small_and_odd_spaces(family):
    for seed in range(10):
        for size in ((6, 6, 3), (8, 9, 3.3), (13, 7, 5), (40, 6, 4)):
            scene = generate(family, drones=3, tasks=5, seed=seed, size=size)
            assert scene.bounds.upper == size


@every_family
def test_big_drones_get_big_scenes(family):
    scene = generate(family, drones=4, tasks=8, radius=0.35, clearance=0.5, separation=2.0)
    assert scene.bounds.upper[0] == pytest.approx(20 * 1.15 * 3.7, abs=0.11)
    assert pdist(places(scene)).min() >= 4.0


def test_default_numbers():
    scene = generate("forest")
    drone = scene.drones[0]
    assert scene.bounds.upper == (20.0, 20.0, 5.0)
    assert (drone.radius, drone.max_speed, drone.max_acceleration, drone.max_jerk) == (0.12, 2.0, 4.0, 30.0)
    assert (scene.clearance, scene.separation, len(scene.obstacles), drone.capacity) == (0.1, 0.4, 8, 3)


def test_crowds_get_more_space():
    scene = generate("forest", drones=50, tasks=350, seed=2)
    assert (scene.num_drones, scene.num_tasks) == (50, 350)
    assert scene.bounds.upper == (40.0, 40.0, 5.0)
    assert len(scene.obstacles) > 30


def test_the_number_of_obstacles_can_be_set():
    assert len(generate("forest", obstacles=0).obstacles) == 0
    assert len(generate("city", obstacles=17).obstacles) == 17


@pytest.mark.parametrize(
    ("arguments", "field", "seen"),
    [
        ({"family": "swamp"}, "family", "'swamp'"),
        ({"family": ["forest"]}, "family", "forest"),
        ({"drones": 0}, "drones", "0"),
        ({"tasks": -1}, "tasks", "-1"),
        ({"tasks": 2.5}, "tasks", "2.5"),
        ({"seed": -1}, "seed", "-1"),
        ({"radius": 0.0}, "radius", "0.0"),
        ({"margin": float("nan")}, "margin", "nan"),
        ({"size": (20, 20)}, "size", "(20, 20)"),
        ({"size": (20, 3, 5)}, "size[1]", "3"),
        ({"spare_capacity": -1}, "spare_capacity", "-1"),
        ({"family": "rooms", "obstacles": 3}, "obstacles", "3"),
        ({"obstacles": 500}, "obstacles", "500"),
        ({"tasks": 300, "size": (6, 6, 3)}, "tasks", "300"),
        ({"drones": 100, "size": (6, 6, 3)}, "drones", "100"),
        ({"colour": "red"}, "colour", "unknown"),
    ],
)
def test_bad_settings_are_named(arguments, field, seen):
    with pytest.raises(SettingsError) as caught:
        generate(**{"family": "forest", **arguments})
    assert caught.value.field == field
    assert seen in caught.value.value


def test_an_unknown_family_lists_the_known():
    with pytest.raises(SettingsError, match="forest, corridor, warehouse, rooms, city"):
        generate("swamp")


@pytest.mark.parametrize("axis", [0, 1])
def test_a_wall_is_cut_around_its_openings(axis):
    wall = Wall(axis, 3.0, 0.0, 10.0, 4.0, 0.2, (Opening(7.0, 1.0, 1.0, 2.0), Opening(2.0, 1.0, 0.0, 4.0)))
    volume = sum(np.prod(size) for _, size in wall.pieces())
    assert volume == pytest.approx((10.0 - 1.0) * 4.0 * 0.2 - 1.0 * 1.0 * 0.2)
    assert all(center[1 - axis] == 3.0 for center, _ in wall.pieces())
    (center, size), _ = wall.gates(0.5)
    assert (center[axis], center[2], size[axis], size[1 - axis], size[2]) == pytest.approx((7.0, 1.5, 1.0, 1.2, 1.0))
