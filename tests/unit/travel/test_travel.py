"""Travel: distances and paths between starts, tasks and ends."""

import math

import numpy as np
import pytest

from flockopt.errors import SettingsError
from flockopt.geometry.kernels import segment_distances
from flockopt.scene import Bounds, Box, Cylinder, Drone, Scene, Sphere, Task
from flockopt.scene.parts import obstacle_table
from flockopt.travel import END, START, Travel
from flockopt.travel.compute import compute_travel
from flockopt.travel.roadmap import Roadmap
from flockopt.travel.travel import straight_travel

BOUNDS = Bounds((0.0, 0.0, 0.0), (20.0, 20.0, 5.0))
NEED = 0.22  # radius + clearance of `drone`


def drone(name="d0", start=(1.0, 1.0, 1.0), **changes):
    fields = {"capacity": 5, "radius": 0.12, "max_speed": 2.0, "max_acceleration": 4.0, "max_jerk": 30.0} | changes
    return Drone(name, start, **fields)


def scene(drones, tasks, obstacles):
    tasks = tuple(Task(f"t{i}", tuple(position)) for i, position in enumerate(tasks))
    return Scene("test", BOUNDS, tuple(drones), tasks, tuple(obstacles), clearance=0.1)


def mixed_scene(seed):
    """Ten obstacles of all shapes and heights, three drones (one with an end, one bigger), eight tasks."""
    rng = np.random.default_rng(seed)
    obstacles = []
    for index in range(10):
        x, y = rng.uniform(3, 17, 2)
        height = rng.uniform(1, 5)
        if index % 3 == 0:
            obstacles.append(Box(f"o{index}", (x, y, height / 2), (*rng.uniform(0.3, 4, 2), height), rng.uniform(-3, 3)))
        elif index % 3 == 1:
            obstacles.append(Cylinder(f"o{index}", (x, y, rng.uniform(1, 4)), rng.uniform(0.4, 1.5), height))
        else:
            obstacles.append(Sphere(f"o{index}", (x, y, rng.uniform(0, 5)), rng.uniform(0.4, 1.5)))
    table = obstacle_table(obstacles)
    points = []
    while len(points) < 12:
        point = rng.uniform((0.5, 0.5, 0.5), (19.5, 19.5, 4.5))
        if segment_distances(table, point[None], point[None]).min() > 0.5:
            points.append(point)
    drones = [drone("d0", points[0]), drone("d1", points[1], end=tuple(points[2])), drone("d2", points[3], radius=0.3)]
    return scene(drones, points[4:], obstacles)


def all_paths(travel, of_scene):
    for index, flyer in enumerate(of_scene.drones):
        for task in range(of_scene.num_tasks):
            yield index, travel.start_task[index, task], travel.path(index, START, task)
            if flyer.end is not None:
                yield index, travel.task_end[index, task], travel.path(index, task, END)
            for other in range(task):
                length = travel.task_task[travel.drone_class[index], task, other]
                yield index, length, travel.path(index, task, other)
        if flyer.end is not None:
            yield index, travel.start_end[index], travel.path(index, START, END)


@pytest.mark.parametrize("seed", range(8))
def test_paths_are_clear_within_bounds_and_as_long_as_their_entries(seed):
    of_scene = mixed_scene(seed)
    travel = compute_travel(of_scene)
    bent = 0
    for index, length, path in all_paths(travel, of_scene):
        need = of_scene.radii[index] + of_scene.clearance
        assert len(path) >= 2 or length == 0.0
        assert segment_distances(of_scene.obstacle_table, path[:-1], path[1:]).min() >= need - 1e-9
        assert (path >= BOUNDS.lower).all() and (path <= BOUNDS.upper).all()
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(length, abs=1e-9)
        assert length >= np.linalg.norm(path[-1] - path[0]) - 1e-9
        bent += len(path) > 2
    assert bent > 10


def test_matrices_are_symmetric_and_paths_reverse():
    of_scene = mixed_scene(0)
    travel = compute_travel(of_scene)
    np.testing.assert_array_equal(travel.task_task, travel.task_task.transpose(0, 2, 1))
    np.testing.assert_array_equal(np.diagonal(travel.task_task, axis1=1, axis2=2), 0.0)
    np.testing.assert_array_equal(travel.path(0, 2, 5), travel.path(0, 5, 2)[::-1])


def test_a_path_around_a_cylinder_has_the_length_of_tangents_and_arc():
    reach = 1.0 + NEED
    roadmap = Roadmap(obstacle_table([Cylinder("c", (10, 10, 2.5), 1.0, 5.0)]), NEED, [BOUNDS.lower, BOUNDS.upper])
    length, path = roadmap.path((5, 10, 1), (15, 10, 1))
    arc = math.pi - 2 * math.acos(reach / 5)
    shortest = 2 * math.sqrt(25 - reach**2) + reach * arc
    assert shortest <= length <= 1.005 * shortest
    climbing, _ = roadmap.path((5, 10, 1), (15, 10, 4))
    assert math.hypot(shortest, 3) <= climbing <= 1.005 * math.hypot(shortest, 3)
    assert len(path) <= 4


def test_a_path_over_a_wall_has_the_length_of_its_profile():
    wall = Box("w", (10, 10, 1), (0.5, 40, 2))
    length, path = Roadmap(obstacle_table([wall]), NEED, [BOUNDS.lower, BOUNDS.upper]).path((5, 10, 1), (15, 10, 1))
    # two tangents to the rounded top edges, from points 1 m under them and 4.75 m beside them
    to_edge, angle = math.hypot(4.75, 1), math.atan2(1, 4.75)
    rise = angle + math.asin(NEED / to_edge)
    shortest = 2 * (math.sqrt(to_edge**2 - NEED**2) + NEED * rise) + 0.5
    assert shortest <= length <= 1.003 * shortest
    assert np.ptp(path[:, 1]) < 0.01


def test_a_path_around_a_sphere_has_the_length_of_tangents_and_arc():
    reach = 1.5 + NEED
    roadmap = Roadmap(obstacle_table([Sphere("s", (10, 10, 2.5), 1.5)]), NEED, [(0, 0, -10), (20, 20, 20)])
    length, _ = roadmap.path((5, 10, 2.5), (15, 10, 2.5))
    shortest = 2 * math.sqrt(25 - reach**2) + reach * (math.pi - 2 * math.acos(reach / 5))
    assert shortest <= length <= 1.01 * shortest


@pytest.mark.parametrize("width", [0.001, 0.05, 0.2])
@pytest.mark.parametrize("turn", [0.0, 0.3, 0.7])
def test_the_one_narrow_gap_in_a_ring_of_cylinders_is_found(width, turn):
    ring, radius = 4.0, 0.7
    half = math.asin((2 * (radius + NEED) + width) / 2 / ring)
    angles = [turn + half, turn - half, *np.linspace(turn + half, turn - half + 2 * math.pi, 26)[1:-1]]
    pillars = [
        Cylinder(f"c{k}", (10 + ring * math.cos(angle), 10 + ring * math.sin(angle), 2.5), radius, 5.0)
        for k, angle in enumerate(angles)
    ]
    outside = (10 + 8 * math.cos(turn + 1), 10 + 8 * math.sin(turn + 1), 2.5)
    table = obstacle_table(pillars)
    length, path = Roadmap(table, NEED, [BOUNDS.lower, BOUNDS.upper]).path((10, 10, 2.5), outside)
    assert length <= 11.3
    assert segment_distances(table, path[:-1], path[1:]).min() >= NEED - 1e-9


def test_a_ring_without_a_gap_has_no_way():
    pillars = [
        Cylinder(f"c{k}", (10 + 4 * math.cos(angle), 10 + 4 * math.sin(angle), 2.5), 0.7, 5.0)
        for k, angle in enumerate(np.linspace(0, 2 * math.pi, 24))
    ]
    roadmap = Roadmap(obstacle_table(pillars), NEED, [BOUNDS.lower, BOUNDS.upper])
    length, path = roadmap.path((10, 10, 2), (1, 1, 2))
    assert math.isinf(length) and path.shape == (0, 3)


def test_a_low_ring_is_left_over_its_top():
    pillars = [
        Cylinder(f"c{k}", (10 + 4 * math.cos(angle), 10 + 4 * math.sin(angle), 1.5), 0.7, 3.0)
        for k, angle in enumerate(np.linspace(0, 2 * math.pi, 24))
    ]
    roadmap = Roadmap(obstacle_table(pillars), NEED, [BOUNDS.lower, BOUNDS.upper])
    length, path = roadmap.path((10, 10, 1), (1, 10, 1))
    assert math.isfinite(length) and path[:, 2].max() > 3.0


def test_a_walled_in_task_is_infinitely_far_and_named():
    walls = [
        Box("north", (10, 12, 2.5), (5, 1, 5)), Box("south", (10, 8, 2.5), (5, 1, 5)),
        Box("east", (12, 10, 2.5), (1, 5, 5)), Box("west", (8, 10, 2.5), (1, 5, 5)),
    ]  # fmt: skip
    of_scene = scene([drone()], [(10, 10, 2), (18, 18, 2)], walls)
    travel = compute_travel(of_scene)
    assert np.isinf(travel.start_task[0, 0]) and np.isinf(travel.task_task[0, 0, 1])
    assert np.isfinite(travel.start_task[0, 1])
    assert travel.path(0, START, 0).shape == (0, 3)
    ((task, reason),) = travel.unreachable(of_scene)
    assert task == 0 and "task 't0'" in reason and "walled in" in reason


def test_a_task_too_near_an_obstacle_for_a_big_drone_is_out_of_its_reach_only():
    pillar = Cylinder("pillar", (10, 10, 2.5), 1.0, 5.0)
    near = (11.3, 10, 2)  # 0.3 m from the pillar
    of_scene = scene([drone(), drone("big", (3, 3, 1), radius=0.4)], [near, (5, 15, 2)], [pillar])
    travel = compute_travel(of_scene)
    assert np.isfinite(travel.start_task[0]).all() and np.isinf(travel.start_task[1, 0])
    assert travel.unreachable(of_scene) == []
    only_big_can_carry = of_scene.replace(drones=(drone(capacity=0), of_scene.drones[1]))
    ((task, reason),) = compute_travel(only_big_can_carry).unreachable(only_big_can_carry)
    assert task == 0 and "'pillar' is 0.3 m away" in reason


def test_places_at_the_very_limit_are_reached():
    pillar = Cylinder("pillar", (10, 10, 2.5), 1.0, 5.0)
    of_scene = scene([drone(start=(10 - 1 - NEED, 10, 1))], [(10 + 1 + NEED, 10, 1)], [pillar])
    travel = compute_travel(of_scene)
    assert math.pi * 1.22 <= travel.start_task[0, 0] <= 1.1 * math.pi * 1.22


def test_without_obstacles_everything_is_straight():
    of_scene = scene([drone(end="start")], [(4, 5, 2), (9, 1, 3)], [])
    travel = compute_travel(of_scene)
    assert travel.start_task[0, 0] == pytest.approx(math.sqrt(9 + 16 + 1))
    np.testing.assert_array_equal(travel.path(0, START, 1), [(1, 1, 1), (9, 1, 3)])
    np.testing.assert_array_equal(travel.path(0, START, END), [(1, 1, 1)])


def test_no_tasks_and_open_ends():
    of_scene = scene([drone()], [], [Sphere("s", (10, 10, 2), 1.0)])
    travel = compute_travel(of_scene)
    assert travel.start_task.shape == (1, 0) and travel.task_task.shape == (1, 0, 0)
    np.testing.assert_array_equal(travel.path(0, START, END), [(1, 1, 1)])


def test_travel_without_paths_says_so():
    bare = Travel(np.zeros((1, 1)), np.zeros((1, 1, 1)), np.zeros((1, 1)), np.zeros(1), np.zeros(1, dtype=np.int64))
    with pytest.raises(SettingsError, match="paths is None"):
        bare.path(0, START, 0)


def test_straight_travel_has_straight_paths():
    of_scene = scene([drone()], [(19, 19, 1)], [Cylinder("c", (10, 10, 2.5), 1.0, 5.0)])
    np.testing.assert_array_equal(straight_travel(of_scene).path(0, 0, START), [(19, 19, 1), (1, 1, 1)])
