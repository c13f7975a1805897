"""The scenes that demonstrations are made in: every family, many sizes, all obstacle shapes; half of them hard.

A hard scene has more obstacles where the family lets one choose, and random bundles in place of good ones: its legs are
long and most of its routes blocked. Good bundles take short legs, of which nine in ten are straight in a forest, and teach
little about going around things.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockopt.bundles import Bundles
from flockopt.errors import SettingsError
from flockopt.flights.waypoints import leg_clear
from flockopt.records import checks
from flockopt.scene import Box, Cylinder, Obstacle, Scene, Sphere
from flockopt.scene.families.generate import generate
from flockopt.scene.families.layouts import FAMILIES
from flockopt.scene.families.settings import FamilySettings
from learned.paths.rollout import anchors_of

__all__ = ["SceneMix", "blocked_routes", "draw_scene", "random_bundles"]

#: Drones and tasks of most scenes, those of the paper; the others have up to so many of each, and so many a drone.
USUAL_SIZE = (10, 20)
MOST_DRONES, MOST_TASKS, MOST_TASKS_A_DRONE = 20, 60, 6

#: How many obstacles hard scenes have, where the family does not decide.
HARD_OBSTACLES = {"forest": (12, 40), "city": (12, 24)}

#: Share of the scenes of those families in which about half of the obstacles give way to other shapes within them.
SHAPES_SHARE = 0.4

#: Random bundles tried for a hard scene; those with the most blocked routes are kept.
HARD_TRIES = 4


@dataclass(frozen=True)
class SceneMix:
    """Which scenes are drawn.

    Attributes:
        family: One of `flockopt.scene.families.layouts.FAMILIES`, or ``all``: each as often.
        hard_share: Share of hard scenes.
        usual_share: Share of scenes with 10 drones and 20 tasks.
        margin: How much farther from obstacles than clearance asks paths keep, metres. Curves through samples, and what
            is learned of them, swing out by centimetres; starts and tasks are 0.15 m farther than they must be.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    family: str = "all"
    hard_share: float = 0.5
    usual_share: float = 0.7
    margin: float = 0.1

    def __post_init__(self) -> None:
        checks.store(self, checks.choice, SettingsError, "family", known=(*FAMILIES, "all"))
        checks.store(self, checks.share, SettingsError, "hard_share", "usual_share")
        checks.store(self, checks.number, SettingsError, "margin")
        most_m = FamilySettings.margin
        if not 0.0 <= self.margin <= most_m:
            rule = f"must be from 0 to {most_m:g} m, what starts and tasks keep"
            raise SettingsError("margin", f"is {self.margin:g}", rule, "choose less")


def draw_scene(mix: SceneMix, seed: int) -> tuple[Scene, bool]:
    """A scene, and whether it is hard; the same for the same mix and seed."""
    rng = np.random.default_rng([seed, 0])
    family = mix.family if mix.family != "all" else str(rng.choice(list(FAMILIES)))
    is_hard = bool(rng.random() < mix.hard_share)
    drones, tasks = USUAL_SIZE
    if rng.random() >= mix.usual_share:
        drones = int(rng.integers(1, MOST_DRONES + 1))
        tasks = int(rng.integers(1, min(MOST_TASKS, MOST_TASKS_A_DRONE * drones) + 1))
    scene = _generate(rng, family, drones, tasks, seed, is_hard)
    if family in HARD_OBSTACLES and rng.random() < SHAPES_SHARE:
        scene = replace(scene, obstacles=tuple(_reshaped(rng, obstacle) for obstacle in scene.obstacles))
    return scene, is_hard


def _generate(rng: np.random.Generator, family: str, drones: int, tasks: int, seed: int, is_hard: bool) -> Scene:
    """A scene of a family; of a hard one as many obstacles as fit, up to a random number."""
    settings: dict[str, Any] = {}
    if is_hard and family in HARD_OBSTACLES:
        settings["obstacles"] = int(rng.integers(*HARD_OBSTACLES[family], endpoint=True))
    while True:
        try:
            return generate(family, drones=drones, tasks=tasks, seed=seed, **settings)
        except SettingsError:
            if settings.get("obstacles", 0) < HARD_OBSTACLES.get(family, (0, 0))[0]:
                raise
            settings["obstacles"] = int(0.8 * settings["obstacles"])


def _reshaped(rng: np.random.Generator, obstacle: Obstacle) -> Obstacle:
    """One time in two another shape within the obstacle: what was clear of it stays clear."""
    if isinstance(obstacle, Sphere) or rng.random() < 0.5:
        return obstacle
    x, y, z = obstacle.center
    height = obstacle.size[2] if isinstance(obstacle, Box) else obstacle.height
    half = min(obstacle.size[:2]) / 2 if isinstance(obstacle, Box) else obstacle.radius
    if rng.random() < 0.5:
        radius = min(half, height / 2)
        return Sphere(obstacle.id, (x, y, z + float(rng.uniform(-1.0, 1.0)) * (height / 2 - radius)), radius)
    if isinstance(obstacle, Box):
        return Cylinder(obstacle.id, obstacle.center, half, height)
    turn = float(rng.uniform(math.pi / 8, 3 * math.pi / 8))  # what the half diagonal makes with a side
    sides = (2 * half * math.cos(turn), 2 * half * math.sin(turn), height)
    return Box(obstacle.id, obstacle.center, sides, float(rng.uniform(-math.pi / 2, math.pi / 2)))


def random_bundles(scene: Scene, seed: int) -> Bundles:
    """Bundles drawn at random within capacities; of a few, those with the most blocked routes."""
    rng = np.random.default_rng([seed, 1])
    slots = np.repeat(np.arange(scene.num_drones), scene.capacities.astype(np.int64))
    best, most = Bundles(()), -1
    for _ in range(HARD_TRIES):
        drones = rng.permutation(slots)[: scene.num_tasks]
        order = rng.permutation(scene.num_tasks)
        bundles = Bundles(tuple(tuple(order[drones == drone].tolist()) for drone in range(scene.num_drones)))
        num_blocked = int(blocked_routes(scene, bundles).sum())
        if num_blocked > most:
            best, most = bundles, num_blocked
    return best


def blocked_routes(scene: Scene, bundles: Bundles) -> NDArray[np.bool_]:
    """Whether an obstacle is in the way of a drone that flies its route straight, (N,)."""
    straight = (anchors_of(scene, drone, route) for drone, route in enumerate(bundles))
    return np.array([not leg_clear(scene, drone, anchors) for drone, anchors in enumerate(straight)])
