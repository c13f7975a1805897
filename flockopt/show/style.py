"""Colours and words that the picture and the page share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flockopt.scene import Box, Cylinder, Obstacle, Scene

if TYPE_CHECKING:
    from flockopt.planfile import Plan

__all__ = ["DANGER", "INK", "MUTED", "drone_color", "drone_round", "extent_z", "headline"]

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


def headline(scene: Scene, plan: Plan | None) -> list[str]:
    """What to say first of a plan: status, travel, proven gap, makespan; of a scene: what is in it."""
    if plan is None or plan.cost is None:
        counts = ((scene.num_drones, "drone"), (scene.num_tasks, "task"), (len(scene.obstacles), "obstacle"))
        words = [f"{count} {noun}{'' if count == 1 else 's'}" for count, noun in counts]
        return words if plan is None else [plan.status, *words]
    cost = plan.cost
    words = [plan.status, f"travel {cost.travel:.1f} m"]
    if cost.gap is not None:
        words.append(f"at most {100 * cost.gap:.2g} % above the optimum")
    return [*words, f"makespan {cost.makespan:.1f} s"]
