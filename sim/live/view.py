"""How a live session stands at one moment: what a page shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from flockopt.certificate import Plan
from flockopt.planning.replan import Replanned
from flockopt.records.arrays import FloatArray
from flockopt.scene import Point

__all__ = ["TaskView", "View"]


@dataclass(frozen=True)
class TaskView:
    """A task as it stands.

    Attributes:
        id: Its id.
        position: m.
        state: ``"open"``, ``"served"``, or ``"left out"`` of the plan.
        drone: Who is to serve it, if it is open.
        reason: Why it is left out.
    """

    id: str
    position: Point
    state: Literal["open", "served", "left out"]
    drone: str | None = None
    reason: str = ""


@dataclass(frozen=True)
class View:
    """How a session stands at one moment.

    Attributes:
        now_s: Seconds flown.
        state: ``"flying"``, ``"paused"``, or ``"waiting"`` for orders with every flight at its end.
        drones: (3,) m by id, of those in the air.
        lost: (3,) m by id, where the lost ones were last.
        tasks: All that are wanted or were served.
        plan: The plan now flown.
        plan_number: Another one whenever a drone's way ahead may have become another.
        swap_s: Seconds until the next plan is swapped in; infinite without one.
        answer: The last answer to an order, or None.
        contacts: How many there have been.
        log: What happened, the latest last.
    """

    now_s: float
    state: Literal["flying", "paused", "waiting"]
    drones: dict[str, FloatArray]
    lost: dict[str, FloatArray]
    tasks: tuple[TaskView, ...]
    plan: Plan
    plan_number: int
    swap_s: float
    answer: Replanned | None
    contacts: int
    log: tuple[str, ...]
