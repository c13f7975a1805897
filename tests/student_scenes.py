"""What the tests of the student share: tiny networks and examples."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from flockopt import generate
from flockopt.travel.compute import compute_travel
from learned.paths.rollout import route_legs
from learned.student.network.model import Student
from learned.student.scenes.examples import example, with_ways
from learned.student.settings import CONFIGS

TINY = {
    name: dataclasses.replace(settings, hidden=16, rounds=2, width=32, blocks=2, heads=2) for name, settings in CONFIGS.items()
}


def tiny_student(config, seed=0):
    """A small network of a configuration, with no layer left at zero."""
    torch.manual_seed(seed)
    student = Student(TINY[config])
    with torch.no_grad():
        for parameter in student.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return student.eval()


def random_routes(scene, seed):
    """Bundles within capacity, drawn at random."""
    rng = np.random.default_rng(seed)
    slots = np.repeat(np.arange(scene.num_drones), scene.capacities.astype(int))
    owners = rng.permutation(slots)[: scene.num_tasks]
    return tuple(tuple(int(task) for task in np.flatnonzero(owners == drone)) for drone in range(scene.num_drones))


def taught_example(family, *, drones=4, tasks=8, seed=0):
    """An example with the any-angle paths as its target."""
    scene = generate(family, drones=drones, tasks=tasks, seed=seed)
    routes = random_routes(scene, seed)
    travel = compute_travel(scene.replace(clearance=scene.clearance + 0.1))
    return with_ways(
        example(scene, routes), [route_legs(scene, drone, route, travel.path) for drone, route in enumerate(routes)]
    )
