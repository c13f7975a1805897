"""What a worker does with some scenes of many: plans them, and says in a row each what came of it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from flockopt.batches.workers import MOST_DEATHS
from flockopt.certificate import Plan
from flockopt.errors import is_interrupt
from flockopt.planning.entries import PLANNING, entries_of
from flockopt.planning.pipeline import plan_together
from flockopt.planning.plan_row import PlanRow
from flockopt.planning.settings import PlanSettings
from flockopt.scene import Scene

__all__ = ["PLANS", "Asked", "Group", "Made", "Work", "each_alone", "name_of"]

#: The folder of plans in that of a run.
PLANS = "plans"

#: Digits of a digest in a file's name, and letters of a scene's.
DIGITS, LETTERS = 12, 60


class Asked(NamedTuple):
    """A scene that is handed to a worker, its key in the journal, and the file that it came from."""

    key: str
    scene: Scene
    source: str = ""


class Made(NamedTuple):
    """What came of it: its row, and its plan file's text where that is kept."""

    key: str
    row: PlanRow
    text: str = ""


#: Scenes that a planner is asked about at once.
Group: TypeAlias = tuple[Asked, ...]


def _stem(scene: Scene) -> str:
    """A name for a scene's plan file, one of a kind."""
    return f"{re.sub(r'[^A-Za-z0-9.-]+', '_', scene.name)[:LETTERS]}-{scene.sha256[:DIGITS]}"


def name_of(group: Group) -> str:
    """A group's name, for those who look for what kills workers."""
    others = f" and {len(group) - 1} others" if len(group) > 1 else ""
    return f"{_stem(group[0].scene)}{others}"


def each_alone(group: Group) -> list[Group]:
    """Groups of one scene each."""
    return [(one,) for one in group]


@cache
def _load_compiled() -> None:
    """Load what is compiled, once in a process, so that no row's seconds hold it."""
    for entry in entries_of(PLANNING).values():
        entry.compile()


@dataclass(frozen=True)
class Work:
    """What a worker does with a group.

    Attributes:
        settings: How to plan.
        planner: Its name.
        keep_plans: Whether plans are to come back too.
    """

    settings: PlanSettings
    planner: str
    keep_plans: bool

    def __call__(self, group: Group) -> list[Made]:
        """What came of each scene; where the group cannot be planned at once, each is planned alone."""
        _load_compiled()
        if len(group) > 1:
            with suppress(_Broken):
                plans = _unbroken(lambda: plan_together([one.scene for one in group], self.settings))
                return [self._made(one, plan) for one, plan in zip(group, plans, strict=True)]
        return [self._alone(one) for one in group]

    def terms(self) -> dict[str, Any]:
        """What all rows of a run share."""
        return {**self.settings.to_dict(), "planner": self.planner, "plans": self.keep_plans}

    def given_up(self, group: Group) -> list[Made]:
        """What is said of scenes that killed too many workers."""
        return [self._broken(one, f"it brought {MOST_DEATHS} workers down") for one in group]

    def unread(self, source: str, reason: str) -> PlanRow:
        """The row of a scene file that cannot be read."""
        return PlanRow.unread(source, Path(source).stem, self.planner, self.settings.seed, reason)

    def _alone(self, one: Asked) -> Made:
        try:
            (plan,) = _unbroken(lambda: plan_together([one.scene], self.settings))
        except _Broken as fault:
            return self._broken(one, str(fault))
        return self._made(one, plan)

    def _made(self, one: Asked, plan: Plan) -> Made:
        kept = f"{PLANS}/{_stem(one.scene)}.json" if self.keep_plans else ""
        text = json.dumps(plan.to_dict(), allow_nan=False) + "\n" if kept else ""
        row = PlanRow.of(one.scene, plan, self.settings.seed, kept)
        return Made(one.key, replace(row, source=one.source), text)

    def _broken(self, one: Asked, reason: str) -> Made:
        row = PlanRow.broken(one.scene, self.planner, self.settings.seed, reason)
        return Made(one.key, replace(row, source=one.source))


class _Broken(Exception):
    """Planning raised something, in words."""


def _unbroken(make: Callable[[], list[Plan]]) -> list[Plan]:
    """What is made; whatever is raised meanwhile, but for an interrupt, is `_Broken`."""
    try:
        return make()
    except Exception as fault:  # whatever goes wrong in one scene is its row, and not the end of a study
        if is_interrupt(fault):
            raise KeyboardInterrupt from fault
        raise _Broken(f"{type(fault).__name__}: {fault}") from fault
