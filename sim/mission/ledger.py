"""What a mission is to do and what has become of it: tasks wanted and served, drones lost and late, and why."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass

from flockopt.certificate import Plan
from flockopt.planning.handover import Changes
from flockopt.scene import Scene

__all__ = ["Due", "Ledger"]


@dataclass(frozen=True)
class Due:
    """Drone ``drone`` is to be at task ``task`` from ``begin_s`` to ``end_s``."""

    begin_s: float
    end_s: float
    drone: str
    task: str


class Ledger:
    """The account of a mission, on its own clock.

    Args:
        scene: Where it begins.
        plan: What is flown first.

    Attributes:
        tasks: Every task that was ever wanted, by id.
        removed: Ids of those withdrawn.
        served: Ids of those that were served.
        missed: Metres by id that its drone was away from a task it should have been serving, of tasks not served since.
        lost: When each lost drone was lost, s.
        late: Until when drones cannot set off, s, by id.
        reasons: Why a task is in no plan, by id.
        due: The visits of what is flown that are still to be judged.
    """

    def __init__(self, scene: Scene, plan: Plan) -> None:
        self.tasks = {task.id: task for task in scene.tasks}
        self.removed: set[str] = set()
        self.served: list[str] = []
        self.missed: dict[str, float] = {}
        self.lost: dict[str, float] = {}
        self.late: dict[str, float] = {}
        self.reasons = dict(plan.unserved)
        self.due: list[Due] = []
        self.expect(plan, 0.0)

    def expect(self, plan: Plan, begin_s: float) -> None:
        """From ``begin_s`` on another plan is flown; what began to be served before is still to be judged."""
        self.due = [due for due in self.due if due.begin_s <= begin_s]
        for drone, flight in plan.flights.items():
            for visit in flight.visits:
                begin = begin_s + visit.time
                if drone not in self.lost:
                    self.due.append(Due(begin, begin + self.tasks[visit.task].service_time, drone, visit.task))
                else:  # a plan that was pending when its drone was lost, and no certified one came after it
                    self.reasons.setdefault(visit.task, f"drone {drone} was to serve it, and is lost")

    def after(self, changes: Changes, now_s: float) -> Ledger:
        """The account after something has happened; this one stays as it is."""
        after = copy(self)
        after.tasks = self.tasks | {task.id: task for task in changes.added}
        after.removed = self.removed | (set(changes.removed) - set(self.served))
        after.served, after.missed, after.reasons = list(self.served), dict(self.missed), dict(self.reasons)
        after.lost = self.lost | dict.fromkeys(changes.lost, now_s)
        after.late = self.late | {drone: now_s + seconds for drone, seconds in changes.late.items()}
        after.due = [due for due in self.due if due.drone not in after.lost]
        return after

    def judge(self, due: Due, metres: float, most: float) -> None:
        """A visit is over: its drone was ``metres`` away at most, where ``most`` are allowed."""
        self.due.remove(due)
        if metres <= most and due.task not in self.served:
            self.served.append(due.task)
            self.missed.pop(due.task, None)
        elif metres > most:
            self.missed[due.task] = metres

    @property
    def open(self) -> tuple[str, ...]:
        """Ids of tasks that are wanted and not served yet."""
        return tuple(task for task in self.tasks if task not in self.removed and task not in self.served)

    @property
    def left(self) -> tuple[str, ...]:
        """Ids of open tasks that nobody is on the way to."""
        expected = {due.task for due in self.due}
        return tuple(task for task in self.open if task not in expected)

    def changes(self, scene: Scene, now_s: float) -> Changes:
        """All that sets the mission apart from the scene that its plan was made for.

        Args:
            scene: That scene.
            now_s: The moment.
        """
        known = {task.id for task in scene.tasks}
        gone = {drone.id for drone in scene.drones} & self.lost.keys()
        return Changes(
            added=tuple(self.tasks[task] for task in self.open if task not in known),
            removed=tuple(task for task in self.tasks if task in known and task in self.removed),
            lost=tuple(drone for drone in self.lost if drone in gone),
            late={drone: until - now_s for drone, until in self.late.items() if until > now_s and drone not in self.lost},
            missed=tuple(task for task in self.left if task in known),
        )

    def refuse(self, reasons: Mapping[str, str], otherwise: str) -> None:
        """No plan came of the last changes: why tasks are left, and nobody waits for being late."""
        self.late.clear()
        self.reasons |= {task: reasons.get(task, otherwise) for task in self.left}

    def unserved(self, service_radius: float) -> dict[str, str]:
        """Reasons by id of the open tasks that nobody is on the way to, as far as there are any.

        Args:
            service_radius: How near a drone had to be, metres.
        """
        found: dict[str, str] = {}
        for task in self.left:
            if task in self.missed:
                metres = self.missed[task]
                found[task] = f"its drone was {metres:.3f} m away from it; {service_radius:g} m count as served"
            elif task in self.reasons:
                found[task] = self.reasons[task]
        return found
