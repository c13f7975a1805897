"""Colours and words that the picture and the page share."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from flockopt.records.status import Status
from flockopt.scene import Box, Cylinder, Obstacle, Scene

if TYPE_CHECKING:
    from flockopt.certificate import Plan

__all__ = ["DANGER", "INK", "MUTED", "drone_color", "drone_round", "extent_z", "headline", "servers"]

#: Told apart by people with any colour vision, on white and on grey: after Okabe & Ito and Paul Tol's "muted".
DRONE_COLORS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#332288", "#56B4E9", "#882255", "#7A7A1F", "#4DB8A4",
)  # fmt: skip

INK, MUTED, DANGER = "#1c2430", "#667080", "#c62f2f"


def drone_color(index: int) -> str:
    """The colour of drone number ``index``; colours come again after ten."""
    return DRONE_COLORS[index % len(DRONE_COLORS)]


def drone_round(index: int) -> int:
    """How often the colours have come round before this drone: what dashes tell apart."""
    return index // len(DRONE_COLORS)


def extent_z(obstacle: Obstacle) -> tuple[float, float]:
    """Lowest and highest z of an obstacle, metres."""
    if isinstance(obstacle, Box):
        half = obstacle.size[2] / 2
    else:
        half = obstacle.height / 2 if isinstance(obstacle, Cylinder) else obstacle.radius
    return obstacle.center[2] - half, obstacle.center[2] + half


def servers(scene: Scene, plan: Plan | None) -> dict[str, int]:
    """Which drone's index serves a task id."""
    routes = {} if plan is None else plan.routes
    return {task: index for index, drone in enumerate(scene.drones) for task in routes.get(drone.id, ())}


def headline(scene: Scene, plan: Plan | None) -> list[str]:
    """What to say first of a plan: status, travel, proven gap, makespan; of a scene: what is in it."""
    counts = ((scene.num_drones, "drone"), (scene.num_tasks, "task"), (len(scene.obstacles), "obstacle"))
    contents = [f"{count} {noun}{'' if count == 1 else 's'}" for count, noun in counts]
    if plan is None:
        return contents
    if plan.status == Status.INFEASIBLE:
        return [f"infeasible: {plan.reason}" if plan.reason else plan.status, *contents]
    words = [_status(plan), f"travel {plan.cost.travel:.1f} m"]
    if plan.cost.gap is not None:
        words.append(_proven(plan.cost.gap))
    return [*words, f"makespan {plan.cost.makespan:.1f} s"]


def _status(plan: Plan) -> str:
    failed = [] if plan.certificate is None else [clause.name for clause in plan.certificate.failed]
    return f"{plan.status}: {', '.join(failed)}" if failed else plan.status


def _proven(gap: float) -> str:
    """The gap, rounded up in its second digit, so that what is said is proven."""
    if gap < 5e-6:
        return "proven optimal"
    digits = 1 - math.floor(math.log10(100 * gap))
    return f"at most {math.ceil(100 * gap * 10**digits - 1e-9) / 10**digits:g} % above the optimum"
