"""flockopt: fleet plans with a certificate that anyone can check again.

Names are loaded when they are first used, so that ``import flockopt`` stays light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flockopt.bundles import Bound, Bundles
    from flockopt.bundles.bounds.bounds import lower_bound
    from flockopt.bundles.refine import refine_bundles
    from flockopt.certificate import Plan
    from flockopt.certificate.judge import certify
    from flockopt.errors import FlockError, MissingExtra, PlanError, SceneError, SettingsError, SolverFailed
    from flockopt.flights import Curve, Flight, Visit
    from flockopt.flights.apart.deconflict import deconflict
    from flockopt.flights.decode import decode
    from flockopt.flights.smoothing.smooth import smooth
    from flockopt.outputs.devices.export import Export, export
    from flockopt.outputs.pictures.drawing import show
    from flockopt.planning.handover import Changes
    from flockopt.planning.many import plan_many
    from flockopt.planning.pipeline import plan
    from flockopt.planning.plan_row import PlanRow
    from flockopt.planning.planners import Planner, Proposal
    from flockopt.planning.replan import replan
    from flockopt.planning.settings import PlanSettings
    from flockopt.scene import Bounds, Box, Cylinder, Drone, Origin, Scene, Sphere, Task
    from flockopt.scene.families.generate import generate
    from flockopt.travel import Travel
    from flockopt.travel.compute import compute_travel

    __version__: str

__all__ = [
    "Bound", "Bounds", "Box", "Bundles", "Changes", "Curve", "Cylinder", "Drone", "Export", "Flight", "FlockError",
    "MissingExtra", "Origin", "Plan", "PlanError", "PlanRow", "PlanSettings", "Planner", "Proposal", "Scene", "SceneError",
    "SettingsError", "SolverFailed", "Sphere", "Task", "Travel", "Visit", "__version__", "certify", "compute_travel", "decode",
    "deconflict", "export", "generate", "lower_bound", "plan", "plan_many", "refine_bundles", "replan", "show", "smooth",
]  # fmt: skip

#: Which module defines each public name.
_HOMES = {
    "flockopt.bundles": ("Bound", "Bundles"),
    "flockopt.bundles.bounds.bounds": ("lower_bound",),
    "flockopt.bundles.refine": ("refine_bundles",),
    "flockopt.certificate": ("Plan",),
    "flockopt.certificate.judge": ("certify",),
    "flockopt.errors": ("FlockError", "MissingExtra", "PlanError", "SceneError", "SettingsError", "SolverFailed"),
    "flockopt.flights": ("Curve", "Flight", "Visit"),
    "flockopt.flights.apart.deconflict": ("deconflict",),
    "flockopt.flights.decode": ("decode",),
    "flockopt.flights.smoothing.smooth": ("smooth",),
    "flockopt.outputs.devices.export": ("Export", "export"),
    "flockopt.outputs.pictures.drawing": ("show",),
    "flockopt.planning.many": ("plan_many",),
    "flockopt.planning.pipeline": ("plan",),
    "flockopt.planning.plan_row": ("PlanRow",),
    "flockopt.planning.handover": ("Changes",),
    "flockopt.planning.planners": ("Planner", "Proposal"),
    "flockopt.planning.replan": ("replan",),
    "flockopt.planning.settings": ("PlanSettings",),
    "flockopt.scene": ("Bounds", "Box", "Cylinder", "Drone", "Origin", "Scene", "Sphere", "Task"),
    "flockopt.scene.families.generate": ("generate",),
    "flockopt.travel": ("Travel",),
    "flockopt.travel.compute": ("compute_travel",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("flockopt")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'flockopt' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
