"""flockopt: fleet plans with a certificate that anyone can check again.

Names are loaded when they are first used, so that ``import flockopt`` stays light.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flockopt.allocate.bounds import lower_bound
    from flockopt.allocate.refine import refine_bundles
    from flockopt.bundles import Bound, Bundles
    from flockopt.certify import certify
    from flockopt.curve import Curve, Flight, Visit
    from flockopt.errors import FlockError, MissingExtra, PlanError, SceneError, SettingsError, SolverFailed
    from flockopt.export import Export, export
    from flockopt.families.generate import generate
    from flockopt.plan import plan
    from flockopt.planfile import Plan
    from flockopt.replan import Changes, replan
    from flockopt.scene import Bounds, Box, Cylinder, Drone, Origin, Scene, Sphere, Task
    from flockopt.show import show
    from flockopt.trajectory.decode import decode
    from flockopt.trajectory.deconflict import deconflict
    from flockopt.trajectory.smooth import smooth
    from flockopt.travel import Travel, compute_travel

    __version__: str

__all__ = [
    "Bound", "Bounds", "Box", "Bundles", "Changes", "Curve", "Cylinder", "Drone", "Export", "Flight", "FlockError",
    "MissingExtra", "Origin", "Plan", "PlanError", "Scene", "SceneError", "SettingsError", "SolverFailed", "Sphere", "Task",
    "Travel", "Visit", "__version__", "certify", "compute_travel", "decode", "deconflict", "export", "generate",
    "lower_bound", "plan", "refine_bundles", "replan", "show", "smooth",
]  # fmt: skip

#: Which module defines each public name.
_HOMES = {
    "flockopt.allocate.bounds": ("lower_bound",),
    "flockopt.allocate.refine": ("refine_bundles",),
    "flockopt.bundles": ("Bound", "Bundles"),
    "flockopt.certify": ("certify",),
    "flockopt.curve": ("Curve", "Flight", "Visit"),
    "flockopt.errors": ("FlockError", "MissingExtra", "PlanError", "SceneError", "SettingsError", "SolverFailed"),
    "flockopt.export": ("Export", "export"),
    "flockopt.families.generate": ("generate",),
    "flockopt.plan": ("plan",),
    "flockopt.planfile": ("Plan",),
    "flockopt.replan": ("Changes", "replan"),
    "flockopt.scene": ("Bounds", "Box", "Cylinder", "Drone", "Origin", "Scene", "Sphere", "Task"),
    "flockopt.show": ("show",),
    "flockopt.trajectory.decode": ("decode",),
    "flockopt.trajectory.deconflict": ("deconflict",),
    "flockopt.trajectory.smooth": ("smooth",),
    "flockopt.travel": ("Travel", "compute_travel"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


class _Package(ModuleType):
    """This package's type: a function stays in view where its module has the same name.

    Loading a submodule binds it to its package, so that ``flockopt.plan`` would turn from a function into a
    module as soon as anyone imports from it.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and _HOME_OF.get(name) == value.__name__:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


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
