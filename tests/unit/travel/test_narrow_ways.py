"""Ways that are only just wide enough are found: the room that paths keep beyond what they must closes none."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import Bounds, Box, Drone, Scene, Task, compute_travel, plan


def door(half_width):
    walls = tuple(Box(f"o{sign}", (0, sign * (half_width + 2.5), 1.25), (0.2, 5.0, 2.5)) for sign in (-1, 1))
    drone = Drone("d", (-2, 0.7, 1), 1, 0.15, 1, 2, 20)
    return Scene("door", Bounds((-5, -5, 0), (5, 5, 2.5)), (drone,), (Task("t", (2, 1, 1)),), walls, clearance=0.1)


@pytest.mark.parametrize("spare_m", [4.5e-3, 1e-3, 1e-5, 0.0])
def test_doors_that_are_only_just_wide_enough_are_passed(spare_m):
    scene = door(0.25 + spare_m)
    assert 4.0 < compute_travel(scene).start_task[0, 0] < 4.4
    assert plan(scene, planner="classical").status == "certified"


def test_a_door_that_is_too_narrow_is_none():
    assert np.isinf(compute_travel(door(0.25 - 1e-5)).start_task[0, 0])
    made = plan(door(0.25 - 1e-5), planner="classical")
    assert made.status == "uncertified"  # nobody proves that ten micrometres are missing
    assert "no way that keeps radius + clearance (0.25 m) was found, which proves nothing" in made.reason
