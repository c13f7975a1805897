"""What grids can tell of walls: proofs that hold, and none where a way leads through."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import plan
from flockopt.geometry.distances import distances
from flockopt.scene import Bounds, Box, Scene, Task
from flockopt.travel.compute import compute_travel
from flockopt.travel.enclosure import Enclosure
from tests.flights import drone

INSIDE, OUTSIDE = (5.0, 5.0, 1.0), (1.0, 1.0, 1.0)
TALL, FLAT = Bounds((0, 0, 0), (10, 10, 3)), Bounds((0, 0, 0.9), (10, 10, 1.1))


def closet(door_m, bounds=TALL):
    """Four walls up to the ceiling around (5, 5), with a door of this width in one of them."""
    side = (4.2 - door_m) / 2
    walls = (
        Box("west", (3.0, 5.0, 1.5), (0.2, 4.2, 3.0)),
        Box("east", (7.0, 5.0, 1.5), (0.2, 4.2, 3.0)),
        Box("north", (5.0, 7.0, 1.5), (4.2, 0.2, 3.0)),
        Box("south-west", (5.0 - (door_m + side) / 2, 3.0, 1.5), (side, 0.2, 3.0)),
        Box("south-east", (5.0 + (door_m + side) / 2, 3.0, 1.5), (side, 0.2, 3.0)),
    )
    return Scene("closet", bounds, (drone(0, OUTSIDE, radius=0.2),), (Task("t", INSIDE),), walls)


def keeps_apart(scene, origin=OUTSIDE, target=INSIDE):
    return Enclosure(scene, 0.2).keeps_apart(np.array(origin), np.array(target))


@pytest.mark.parametrize("bounds", [TALL, FLAT])
def test_a_closed_room_is_proven_to_be_closed(bounds):
    assert keeps_apart(closet(0.0, bounds))
    result = plan(closet(0.0, bounds), planner="classical")
    assert result.status == "infeasible"
    assert "there is no way that keeps radius + clearance (0.2 m), and that is proven" in result.reason


@pytest.mark.parametrize("door_m", [0.42, 0.5, 1.0, 3.0])
def test_a_door_that_lets_a_drone_through_is_never_called_closed(door_m):
    assert not keeps_apart(closet(door_m))
    assert plan(closet(door_m), planner="classical").status == "certified"


def test_a_door_too_narrow_by_far_is_proven_closed_and_one_too_narrow_by_little_is_not_told():
    assert keeps_apart(closet(0.2))
    assert not keeps_apart(closet(0.395))
    result = plan(closet(0.395), planner="classical")
    assert result.status == "uncertified"
    assert "was found, which proves nothing" in result.reason


def test_an_end_behind_walls_is_out_of_reach():
    scene = closet(0.0).replace(tasks=(), drones=(drone(0, OUTSIDE, radius=0.2, end=INSIDE),))
    result = plan(scene, planner="classical")
    assert result.status == "infeasible"
    assert "drone 'd0': there is no way to its end, and that is proven" in result.reason


def test_a_place_inside_an_obstacle_is_out_of_reach_and_open_air_is_not():
    assert keeps_apart(closet(1.0), target=(3.0, 5.0, 1.0))
    assert not keeps_apart(closet(1.0).replace(obstacles=()))


@pytest.mark.parametrize("seed", range(20))
def test_between_places_that_are_proven_apart_there_is_no_way(seed):
    rng = np.random.default_rng(seed)
    centers, sizes = rng.uniform(0.0, 6.0, (12, 3)), rng.uniform(0.3, 5.0, (12, 3))
    boxes = tuple(Box(f"b{k}", tuple(center), tuple(size)) for k, (center, size) in enumerate(zip(centers, sizes, strict=True)))
    bounds = Bounds((0, 0, 0), (6, 6, 6))
    places = [tuple(place) for place in rng.uniform(0.1, 5.9, (400, 3))]
    free = [place for place in places if all(distances(_row(box), place)[0, 0] > 0.11 for box in boxes)][:12]
    scene = Scene(
        "boxes",
        bounds,
        (drone(0, free[0], radius=0.1),),
        tuple(Task(f"t{j}", place) for j, place in enumerate(free[1:])),
        boxes,
    )
    reach, walls = np.isfinite(compute_travel(scene).start_task[0]), Enclosure(scene, 0.1)
    for task, reached in zip(scene.tasks, reach, strict=True):
        assert not (reached and walls.keeps_apart(scene.starts[0], np.array(task.position)))


def _row(box):
    return np.array([[0.0, *box.center, *(0.5 * np.array(box.size)), 1.0, 0.0]])
