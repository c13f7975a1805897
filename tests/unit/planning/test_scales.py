"""Drones of a tenth of a millimetre and of a hundred metres are planned as those between."""

from __future__ import annotations

import dataclasses

import pytest

from flockopt import Bounds, generate, plan


def scaled(scene, factor):
    def there(place):
        return tuple(factor * value for value in place)

    def obstacle(record):
        sizes = ("size", "radius", "height")
        more = {name: getattr(record, name) for name in sizes if hasattr(record, name)}
        more = {name: there(value) if isinstance(value, tuple) else factor * value for name, value in more.items()}
        return dataclasses.replace(record, center=there(record.center), **more)

    rates = ("radius", "max_speed", "max_acceleration", "max_jerk")
    return scene.replace(
        bounds=Bounds(there(scene.bounds.lower), there(scene.bounds.upper)),
        drones=tuple(
            dataclasses.replace(drone, start=there(drone.start), **{name: factor * getattr(drone, name) for name in rates})
            for drone in scene.drones
        ),
        tasks=tuple(dataclasses.replace(task, position=there(task.position)) for task in scene.tasks),
        obstacles=tuple(map(obstacle, scene.obstacles)),
        clearance=factor * scene.clearance,
        separation=factor * scene.separation,
    )


@pytest.mark.parametrize("factor", [1e-3, 1e-2, 1e2, 1e3])
@pytest.mark.parametrize("family", ["forest", "rooms"])
def test_small_and_large_scenes_are_planned_as_those_between(family, factor):
    scene = generate(family, drones=4, tasks=8, seed=0)
    made, there = plan(scene, planner="classical"), plan(scaled(scene, factor), planner="classical")
    assert there.status == made.status == "certified"
    assert there.cost.travel / factor == pytest.approx(made.cost.travel, rel=0.01)
    assert there.cost.makespan == pytest.approx(made.cost.makespan, rel=0.15)
