"""Where a scene is planned: near zero, and among as few obstacles as fill the same space.

What comes of it is handed back in the scene's own coordinates and judged there, against the scene's own obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.certificate import Plan
from flockopt.certificate.judge import certify
from flockopt.certificate.placement import flights_from
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.scene.frame import Frame
from flockopt.scene.merging import with_merged_obstacles
from flockopt.travel import Travel

__all__ = ["Workplace"]


@dataclass(frozen=True)
class Workplace:
    """A scene made easy to plan.

    Attributes:
        asked: The scene that a plan is asked for.
        frame: In which it is planned.
        scene: The scene in that frame with its boxes joined; ``asked`` itself where neither changes anything.
    """

    asked: Scene
    frame: Frame
    scene: Scene

    @classmethod
    def of(cls, asked: Scene) -> Workplace:
        """The workplace for a scene."""
        frame = Frame.of(asked.bounds)
        return cls(asked, frame, with_merged_obstacles(frame.near(asked)))

    @property
    def is_asked(self) -> bool:
        """Whether the scene is planned as it is."""
        return self.scene is self.asked

    def asked_about(self, left: Scene) -> Scene:
        """The scene that is asked about where some tasks are left out of the one that is planned."""
        if self.is_asked:
            return left
        kept = {task.id for task in left.tasks}
        return self.asked.replace(tasks=tuple(task for task in self.asked.tasks if task.id in kept))

    def handed_back(self, plan: Plan, asked: Scene, travel: Travel | None = None, deadline: Deadline = NEVER) -> Plan:
        """The plan for the scene that is asked about, judged anew unless that is the one that was planned.

        Args:
            plan: What was planned.
            asked: The scene that is asked about (`asked_about`).
            travel: Of the scene that was planned; computed when left out.
            deadline: When to give up.

        Raises:
            OutOfTime: If the deadline passes.
        """
        if self.is_asked:
            return plan
        flights = flights_from(self.frame, plan.flights)
        plan = replace(plan, scene_name=asked.name, scene_sha256=asked.sha256, flights=flights)
        if plan.status == Status.INFEASIBLE:
            return plan
        certificate = certify(asked, plan, travel=travel, deadline=deadline)
        return replace(plan, status=Status.CERTIFIED if certificate.certified else Status.UNCERTIFIED, certificate=certificate)
