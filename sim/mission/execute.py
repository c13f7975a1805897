"""Fly a plan in PyBullet and record what happens."""

from __future__ import annotations

from flockopt.certificate import Plan
from flockopt.scene import Scene
from flockopt.travel import Travel
from sim.mission.execution import Execution
from sim.mission.mission import Mission
from sim.physics.settings import FlightSettings

__all__ = ["Execution", "execute"]


def execute(
    scene: Scene,
    plan: Plan,
    settings: FlightSettings | None = None,
    *,
    force: bool = False,
    travel: Travel | None = None,
    gui: bool = False,
) -> Execution:
    """Fly a plan.

    Args:
        scene: The scene.
        plan: A plan for it. What it says of itself is not believed: it is certified anew.
        settings: How to fly; the defaults otherwise.
        force: Fly it even if a clause of its certificate fails.
        travel: The scene's travel, if it is at hand; the judge computes it otherwise.
        gui: Whether to open PyBullet's window and fly no faster than real time.

    Raises:
        PlanError: If the plan is for another scene, or does not hold and ``force`` is not set.
        SettingsError: If the controller does not fly the vehicle.
        MissingExtra: If PyBullet is not installed.
    """
    with Mission(scene, plan, settings, force=force, travel=travel, gui=gui) as mission:
        return mission.finish().flight
