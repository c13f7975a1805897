"""A PyBullet world made from a scene: its obstacles, its drones, and what touches what.

A step writes each drone's mean velocity, which `sim.physics.fleet` has worked out from thrust, gravity and drag; PyBullet
moves the bodies and finds and resolves contacts. A body that nothing is near to ends where that velocity takes it, which is
known without asking. PyBullet has no calls for many bodies at once, and each call costs as much as a drone's whole
controller: so it is asked only in steps in which something comes within `REACH_M` of touching, and only the poses and
velocities of bodies with contact points are read back. Its bodies catch up before such a step (a test flies both ways and
compares).
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType, TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from flockopt.errors import SettingsError, SolverFailed, require
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import Box, Cylinder, Obstacle, Point, Scene
from sim.physics.fleet import POSE, RATES, VELOCITY
from sim.physics.proximity import within_reach
from sim.physics.vehicles import Vehicle

__all__ = ["SHAPES", "Touch", "World", "load_pybullet"]

#: Collision shapes of a drone: the scene's ball, or a flat cylinder inside it.
SHAPES = ("ball", "disc")

#: The flat cylinder's height over its diameter; its rims are on the ball.
DISC_FLATNESS = 0.25

#: PyBullet is asked when surfaces come nearer than this, metres; it makes contact points from 0.02 m on.
REACH_M = 0.05

#: How bouncy and how rough drones are.
RESTITUTION, FRICTION = 0.2, 0.4

COLORS = ((0.12, 0.47, 0.71, 1), (1.0, 0.5, 0.05, 1), (0.17, 0.63, 0.17, 1), (0.84, 0.15, 0.16, 1), (0.58, 0.4, 0.74, 1))
GREY = (0.62, 0.65, 0.7, 1)


def load_pybullet() -> ModuleType:
    """The module pybullet.

    Raises:
        MissingExtra: If it is not installed.
    """
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    with _silence():
        pybullet: ModuleType = require("pybullet", extra="sim")
    return pybullet


@contextmanager
def _silence() -> Iterator[None]:
    """Drop what C code writes to standard error: on import PyBullet tells when it was built."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@dataclass(frozen=True)
class Touch:
    """Drone ``drone`` touches ``other``, a drone or an obstacle, from ``time`` on (s)."""

    time: float
    drone: str
    other: str


class World:
    """A PyBullet server that holds a scene; to be used in a ``with`` statement.

    Args:
        scene: The scene.
        vehicles: One for each drone.
        step_s: Seconds a step, > 0.
        shape: One of `SHAPES`, the drones' collision shape.
        gui: Whether to open a window; the server is in this process without one otherwise.
        every_step: Whether PyBullet moves all bodies in every step, as a window needs it.

    Raises:
        MissingExtra: If PyBullet is not installed.
        SettingsError: On an unknown shape, or a step that is not positive.
        SolverFailed: If PyBullet cannot connect.
    """

    def __init__(
        self, scene: Scene, vehicles: list[Vehicle], step_s: float, *, shape: str = "ball", gui: bool = False,
        every_step: bool = False,
    ) -> None:  # fmt: skip
        checks.choice(SettingsError, "shape", shape, known=SHAPES)
        self._every_step = every_step or gui
        self.step_s = checks.number(SettingsError, "step_s", step_s, above=0.0)
        self._scene, self._bullet = scene, load_pybullet()
        self.client: int = self._bullet.connect(self._bullet.GUI if gui else self._bullet.DIRECT)
        if self.client < 0:
            raise SolverFailed("pybullet", "no window could be opened" if gui else "no server could be started")
        self._set_physics()
        self._names = {self._place(obstacle): obstacle.id for obstacle in scene.obstacles}
        self.bodies = [self._launch(i, vehicle, shape) for i, vehicle in enumerate(vehicles)]
        self._names |= {body: drone.id for body, drone in zip(self.bodies, scene.drones, strict=True)}
        self._number = {body: i for i, body in enumerate(self.bodies)}
        self._touching: frozenset[tuple[int, int]] = frozenset()
        self._radii = np.array(scene.radii)
        self._poses = np.zeros((scene.num_drones, 7))  # where the bodies are, or will be once they have caught up
        self._poses[:, :3], self._poses[:, 6], self._is_behind = scene.starts, 1.0, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Shut the server down."""
        if self.client >= 0:
            self._bullet.disconnect(physicsClientId=self.client)
            self.client = -1

    def remove(self, row: int) -> None:
        """Take a drone out of the world; those after it move up a row."""
        body = self.bodies.pop(row)
        self._bullet.removeBody(body, physicsClientId=self.client)
        self._number = {body: i for i, body in enumerate(self.bodies)}
        self._touching = frozenset(pair for pair in self._touching if body not in pair)
        self._radii, self._poses = np.delete(self._radii, row), np.delete(self._poses, row, axis=0)

    def step(self, states: FloatArray, drive: FloatArray, spin: FloatArray, time: float) -> list[Touch]:
        """Let the drones move for one step.

        Args:
            states: (N, 17) as in `sim.physics.fleet`, where the drones will be if nothing is in their way; poses and
                velocities of those that touch something are brought up to date.
            drive: (N, 3) velocities to move with, m/s.
            spin: (N, 3) rad/s in the world frame, to turn with.
            time: At the end of the step, s.

        Returns:
            What touches now and did not before.
        """
        scene = self._scene
        touches: list[Touch] = []
        if self._every_step or within_reach(
            scene.obstacle_table, scene.obstacle_boxes, self._radii, states, drive, self.step_s, REACH_M
        ):
            self._catch_up()
            touches = self._moved(states, drive, spin, time)
        else:
            self._is_behind, self._touching = True, frozenset()
        np.copyto(self._poses, states[:, POSE])
        return touches

    def _catch_up(self) -> None:
        """Put PyBullet's bodies where the drones are."""
        if self._is_behind:
            for body, pose in zip(self.bodies, self._poses.tolist(), strict=True):
                self._bullet.resetBasePositionAndOrientation(body, pose[:3], pose[3:], self.client)
            self._is_behind = False

    def _moved(self, states: FloatArray, drive: FloatArray, spin: FloatArray, time: float) -> list[Touch]:
        """Let PyBullet move the bodies; arguments and result as of `step`."""
        write, client = self._bullet.resetBaseVelocity, self.client
        for body, velocity, turning in zip(self.bodies, drive.tolist(), spin.tolist(), strict=True):
            write(body, velocity, turning, client)
        self._bullet.stepSimulation(client)
        contacts = self._bullet.getContactPoints(physicsClientId=client)
        return self._touches(contacts, states, time) if contacts or self._touching else []

    def _touches(self, contacts: Any, states: FloatArray, time: float) -> list[Touch]:
        """Read back what the contact solver may have moved, and say what touches since this step."""
        pairs, moved = set(), set()
        for contact in contacts:
            first, second, gap, force = contact[1], contact[2], contact[8], contact[9]
            moved.update({first, second} & self._number.keys())
            if gap <= 0.0 or force > 0.0:  # bodies that would meet within the step are pushed apart before it
                pairs.add((first, second) if first in self._number else (second, first))
        for body in moved:
            self._read(body, states[self._number[body]])
        fresh = sorted(pairs - self._touching)
        self._touching = frozenset(pairs)
        return [Touch(time, self._names[body], self._names[other]) for body, other in fresh]

    def _read(self, body: int, state: FloatArray) -> None:
        place, attitude = self._bullet.getBasePositionAndOrientation(body, self.client)
        velocity, spin = self._bullet.getBaseVelocity(body, self.client)
        turn = np.array(self._bullet.getMatrixFromQuaternion(attitude)).reshape(3, 3)
        state[POSE], state[VELOCITY], state[RATES] = place + attitude, velocity, turn.T @ np.array(spin)

    def image(self, width: int, height: int, *, yaw: float = -45.0, pitch: float = -45.0) -> NDArray[np.uint8]:
        """A picture of the world by PyBullet's software renderer, (height, width, 3)."""
        self._catch_up()
        lower, upper = np.array(self._scene.bounds.lower), np.array(self._scene.bounds.upper)
        reach = float(np.linalg.norm(upper - lower))
        middle = ((lower + upper) / 2).tolist()
        view = self._bullet.computeViewMatrixFromYawPitchRoll(middle, 1.1 * reach, yaw, pitch, 0.0, 2)
        lens = self._bullet.computeProjectionMatrixFOV(45.0, width / height, 0.01 * reach, 3.0 * reach)
        renderer = self._bullet.ER_TINY_RENDERER
        pixels = self._bullet.getCameraImage(width, height, view, lens, renderer=renderer, physicsClientId=self.client)[2]
        return np.reshape(pixels, (height, width, 4))[:, :, :3].astype(np.uint8)

    def _set_physics(self) -> None:
        self._bullet.setGravity(0.0, 0.0, 0.0, physicsClientId=self.client)  # it is in the velocities already
        self._bullet.setPhysicsEngineParameter(
            fixedTimeStep=self.step_s, numSubSteps=0, deterministicOverlappingPairs=1, physicsClientId=self.client
        )

    def _place(self, obstacle: Obstacle) -> int:
        """Put an obstacle into the world; it never moves."""
        bullet, turn = self._bullet, (0.0, 0.0, 0.0, 1.0)
        size: dict[str, Any]
        if isinstance(obstacle, Box):
            kind, size = bullet.GEOM_BOX, {"halfExtents": [side / 2 for side in obstacle.size]}
            turn = (0.0, 0.0, math.sin(obstacle.yaw / 2), math.cos(obstacle.yaw / 2))
        elif isinstance(obstacle, Cylinder):
            kind, size = bullet.GEOM_CYLINDER, {"radius": obstacle.radius, "height": obstacle.height}
        else:
            kind, size = bullet.GEOM_SPHERE, {"radius": obstacle.radius}
        return self._body(kind, size, GREY, 0.0, obstacle.center, turn)

    def _launch(self, index: int, vehicle: Vehicle, shape: str) -> int:
        """Put a drone at its start."""
        bullet, drone = self._bullet, self._scene.drones[index]
        if shape == "ball":
            kind, size = bullet.GEOM_SPHERE, {"radius": drone.radius}
        else:
            wide = drone.radius / math.hypot(1.0, DISC_FLATNESS)
            kind, size = bullet.GEOM_CYLINDER, {"radius": wide, "height": 2.0 * DISC_FLATNESS * wide}
        body = self._body(kind, size, COLORS[index % len(COLORS)], vehicle.mass, drone.start, (0.0, 0.0, 0.0, 1.0))
        # Without the mass, setting the inertia makes the mass NaN. The same inertia about all axes keeps PyBullet from adding
        # gyroscopic torques, which are in the spin that it is given; to contacts the difference is small.
        inertia = [sum(vehicle.inertia) / 3.0] * 3
        bullet.changeDynamics(
            body, -1, mass=vehicle.mass, localInertiaDiagonal=inertia, linearDamping=0.0, angularDamping=0.0,
            restitution=RESTITUTION, lateralFriction=FRICTION, activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=self.client,
        )  # fmt: skip
        return body

    def _body(
        self, kind: int, size: Mapping[str, Any], color: tuple[float, ...], mass: float, place: Point, turn: tuple[float, ...]
    ) -> int:
        """Make a body of one shape, which PyBullet numbers; a mass of 0 stays where it is."""
        bullet = self._bullet
        shape = bullet.createCollisionShape(kind, **size, physicsClientId=self.client)
        look = {"length" if key == "height" else key: value for key, value in size.items()}
        visual = bullet.createVisualShape(kind, **look, rgbaColor=color, physicsClientId=self.client)
        number: int = bullet.createMultiBody(
            mass, shape, visual, place, turn, useMaximalCoordinates=True, physicsClientId=self.client
        )
        return number
