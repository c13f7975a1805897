"""One way in for all exports: for which device, into which directory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from flockopt.certificate import Plan
from flockopt.errors import PlanError, SettingsError
from flockopt.outputs.devices import crazyswarm2, qgroundcontrol
from flockopt.outputs.devices.directory import MANIFEST, check_directory, write_directory
from flockopt.records import checks
from flockopt.records.status import Status
from flockopt.scene import Scene

__all__ = ["DEVICES", "Export", "export"]

DEVICES = ("crazyswarm2", "qgroundcontrol")


@dataclass(frozen=True)
class Export:
    """What came of an export.

    Attributes:
        files: Names of the files in the directory; empty if nothing was written.
        misfits: What does not fit the device, and how to mend it; empty if all does.
    """

    files: tuple[str, ...]
    misfits: tuple[str, ...]


def export(plan: Plan, *, to: str, path: str | Path, scene: Scene | None = None) -> Export:
    """Write a plan for real drones, into a directory written whole or not at all.

    Args:
        plan: What to fly. Whether it is certified is its reader's business.
        to: ``"crazyswarm2"``: a CSV for each drone, and the YAML of the fleet; ``"qgroundcontrol"``: a mission for each.
        path: The directory, which must be new, empty or an earlier export that nobody changed.
        scene: The plan's scene: needed for QGroundControl, as it says where on Earth things are; Crazyswarm2 learns
            from it where the drones are that do not move.

    Returns:
        The files written, or what does not fit the device; then nothing is written.

    Raises:
        SettingsError: If the device is unknown, the scene is missing, or the directory cannot be written.
        PlanError: If the plan is for another scene.
        SceneError: If the scene has no origin and the device needs one.
        MissingExtra: If PyYAML is needed and not installed.
    """
    if to not in DEVICES:
        raise SettingsError("to", f"is {checks.shown(to)}", f"must be one of {', '.join(DEVICES)}", "choose one")
    if scene is None and to == "qgroundcontrol":
        raise SettingsError("scene", "is missing", "it says where on Earth the plan is", "give the plan's scene")
    if scene is not None and scene.sha256 != plan.scene_sha256:
        seen, rule = f"is {plan.scene_sha256}", f"must be {scene.sha256}, the digest of scene {checks.shown(scene.name)}"
        raise PlanError("scene.sha256", seen, rule, "export with the scene that the plan was made for")
    check_directory(path)
    if not plan.flights:
        why = f"it is infeasible: {plan.reason}" if plan.status == Status.INFEASIBLE else "no drone moves"
        return Export((), (f"the plan has nothing to fly: {why}",))
    if to == "crazyswarm2":
        files, misfits = crazyswarm2.convert(plan, scene)
    else:
        files, misfits = qgroundcontrol.convert(plan, scene)  # type: ignore[arg-type]  # a scene is there, see above
    if misfits:
        return Export((), tuple(misfits))
    write_directory(path, files, {"to": to, "scene": {"name": plan.scene_name, "sha256": plan.scene_sha256}})
    return Export((*files, MANIFEST), ())
