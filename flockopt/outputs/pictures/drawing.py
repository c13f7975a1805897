"""One way in for all drawings: the file's suffix says which."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from flockopt.errors import PlanError, SettingsError
from flockopt.records import checks, files
from flockopt.scene import Scene

if TYPE_CHECKING:
    from flockopt.certificate import Plan

__all__ = ["SUFFIXES", "show"]

SUFFIXES = (".png", ".html")


def show(scene: Scene, path: str | Path, plan: Plan | None = None) -> None:
    """Draw a scene, or a plan in its scene, into a file written whole or not at all.

    Args:
        scene: What to draw.
        path: ``.png`` for a picture: top view, altitude, least separation and clearance over time. ``.html`` for
            one self-contained page that plays the flight in 3-D, with no network and no server.
        plan: Draws routes and motion too. Least distances are sampled for the picture; the proof is the plan's
            certificate.

    Raises:
        SettingsError: If the suffix is another one, or the file cannot be written.
        PlanError: If the plan is for another scene.
        MissingExtra: If a picture is asked for and matplotlib is not installed.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        rule = f"must end in {' or '.join(SUFFIXES)}"
        raise SettingsError("path", f"is {str(path)!r}", rule, "choose one of the two")
    if plan is not None and plan.scene_sha256 != scene.sha256:
        seen, rule = f"is {plan.scene_sha256}", f"must be {scene.sha256}, the digest of scene {checks.shown(scene.name)}"
        raise PlanError("scene.sha256", seen, rule, "draw the scene that the plan was made for")
    files.check_output(SettingsError, path)
    content: str | bytes
    if suffix == ".png":
        from flockopt.outputs.pictures.picture import picture  # late: neither drawing needs the other's code

        content = picture(scene, plan)
    else:
        from flockopt.outputs.pictures.page import page

        content = page(scene, plan)
    files.write_whole(SettingsError, path, content)
