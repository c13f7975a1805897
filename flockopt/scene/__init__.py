"""What is asked: drones, tasks, obstacles, bounds."""

from flockopt.scene.parts import Bounds, Box, Cylinder, Drone, Obstacle, Origin, Point, Sphere, Task
from flockopt.scene.scene import Scene

__all__ = ["Bounds", "Box", "Cylinder", "Drone", "Obstacle", "Origin", "Point", "Scene", "Sphere", "Task"]
