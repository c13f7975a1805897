"""Stages of closed-form flights for the tests of timed flights."""

from __future__ import annotations

from flockopt import compute_travel, decode, generate, refine_bundles
from flockopt.flights.smoothing.stages import split
from learned.demonstrations.timed_shards import StageRecord


def flown(family="forest", drones=5, tasks=10, seed=0):
    """A scene and its closed-form flights."""
    scene = generate(family, drones=drones, tasks=tasks, seed=seed)
    travel = compute_travel(scene)
    return scene, decode(scene, refine_bundles(scene, travel=travel, iterations=100, seed=seed), travel=travel)


def moving_stages(scene, flights):
    """(drone, stage without slivers) of everything that moves."""
    drones = {drone.id: drone for drone in scene.drones}
    return [
        (drones[name], stage.without_slivers())
        for name, flight in flights.items()
        for stage in split(flight)
        if not stage.rests
    ]


def records(family="forest", **size):
    """The records of a scene's stages, without a teacher."""
    scene, flights = flown(family, **size)
    return [StageRecord.of(scene, drone, stage) for drone, stage in moving_stages(scene, flights)]
