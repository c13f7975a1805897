"""What can happen to a flying fleet, and seeded schedules of it.

Tasks come and go, drones fail, a drone is late to take off, the wind gusts. Events are facts with a moment; what becomes
of them is the mission's affair (`sim.mission.mission`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from flockopt.certificate import Plan
from flockopt.errors import SceneError, SettingsError
from flockopt.planning.handover import Changes
from flockopt.records import checks
from flockopt.scene import Scene, Task
from sim.mission.wind import Gust

__all__ = [
    "KINDS", "DroneLate", "DroneLost", "Event", "EventSettings", "TaskAdded", "TaskRemoved", "random_task", "schedule",
]  # fmt: skip

#: What can happen: tasks added and removed, drones lost and late, gusts.
KINDS = ("added", "removed", "lost", "late", "gust")

#: Keeps the schedules' random numbers apart from those that scenes and planners draw from the same seed.
STREAM = 5

#: How often a random place is drawn before the scene counts as full.
MOST_DRAWS = 2000


@dataclass(frozen=True)
class TaskAdded:
    """From ``time_s`` on there is one more task."""

    time_s: float
    task: Task

    @property
    def changes(self) -> Changes:
        """What it changes."""
        return Changes(added=(self.task,))


@dataclass(frozen=True)
class TaskRemoved:
    """From ``time_s`` on a task needs no visit any more."""

    time_s: float
    task: str

    @property
    def changes(self) -> Changes:
        """What it changes."""
        return Changes(removed=(self.task,))


@dataclass(frozen=True)
class DroneLost:
    """At ``time_s`` a drone drops out."""

    time_s: float
    drone: str

    @property
    def changes(self) -> Changes:
        """What it changes."""
        return Changes(lost=(self.drone,))


@dataclass(frozen=True)
class DroneLate:
    """At ``time_s`` it turns out that a drone that stands still cannot set off for another ``seconds``."""

    time_s: float
    drone: str
    seconds: float

    @property
    def changes(self) -> Changes:
        """What it changes."""
        return Changes(late={self.drone: self.seconds})


Event: TypeAlias = TaskAdded | TaskRemoved | DroneLost | DroneLate | Gust


@dataclass(frozen=True)
class EventSettings:
    """What is to happen in a flight.

    Attributes:
        number: How many events.
        kinds: Of which kinds, see `KINDS`; each is as likely as any other that is possible.
        within: They happen in this share of the plan's makespan from the beginning.
        most_late_s: How late a drone is at most, seconds.
        gust_mps: Speed of the air in the middle of a gust, m/s.
        gust_s: How long a gust lasts, seconds.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    number: int = 4
    kinds: tuple[str, ...] = KINDS
    within: float = 0.8
    most_late_s: float = 5.0
    gust_mps: float = 1.0
    gust_s: float = 1.0

    def __post_init__(self) -> None:
        checks.store(self, checks.integer, SettingsError, "number", least=1)
        checks.store(self, checks.number, SettingsError, "within", "most_late_s", "gust_mps", "gust_s", above=0.0)
        object.__setattr__(self, "kinds", tuple(self.kinds))
        for kind in self.kinds or ("",):
            if kind not in KINDS:
                raise SettingsError("kinds", f"hold {kind!r}", f"must be some of {', '.join(KINDS)}", "choose some")


def schedule(scene: Scene, plan: Plan, seed: int, settings: EventSettings | None = None) -> tuple[Event, ...]:
    """What happens to a plan in flight, in order of time; the same for the same seed.

    Drones are late before they take off, at time 0. Some drone is always left. A gust that would begin in another one comes
    after it, so that the air is never faster than a gust is to be.

    Args:
        scene: Where it is flown.
        plan: The plan.
        seed: For everything random.
        settings: How much is to happen; the defaults otherwise.

    Raises:
        SettingsError: If nothing of the kinds asked for can happen any more.
    """
    settings = settings or EventSettings()
    dice = _Dice(scene, plan, settings, np.random.default_rng([seed, STREAM]))
    moments = np.sort(dice.rng.uniform(0.0, settings.within * plan.cost.makespan, settings.number)).tolist()
    return tuple(sorted((dice.event(moment) for moment in moments), key=lambda event: event.time_s))


class _Dice:
    """Draws events that are possible after those drawn before."""

    def __init__(self, scene: Scene, plan: Plan, settings: EventSettings, rng: np.random.Generator) -> None:
        self.scene, self.settings, self.rng = scene, settings, rng
        self.visits = {visit.task: visit.time for flight in plan.flights.values() for visit in flight.visits}
        self.drones = [drone.id for drone in scene.drones]
        self.punctual = [drone.id for drone in scene.drones if drone.id in plan.flights and not _moves(scene, drone.id)]
        self.count, self.calm_s = 0, 0.0

    def event(self, time_s: float) -> Event:
        """The next event, at this time or, if somebody is late, at the beginning."""
        kinds = list(self.settings.kinds)
        while kinds:
            kind = kinds.pop(int(self.rng.integers(len(kinds))))
            event = self._makers()[kind](time_s)
            if event is not None:
                self.count += 1
                return event
        raise SettingsError(
            "kinds", f"are {', '.join(self.settings.kinds)}", "one must be possible", "add kinds or ask for fewer"
        )

    def _makers(self) -> dict[str, Callable[[float], Event | None]]:
        return {"added": self._added, "removed": self._removed, "lost": self._lost, "late": self._late, "gust": self._gust}

    def _added(self, time_s: float) -> Event | None:
        name = f"new{self.count}"
        while any(task.id == name for task in self.scene.tasks):
            name += "+"
        task = random_task(self.scene, name, self.rng)
        return None if task is None else TaskAdded(time_s, task)

    def _removed(self, time_s: float) -> Event | None:
        ahead = [task for task, visit_s in self.visits.items() if visit_s > time_s]
        return TaskRemoved(time_s, self._drawn(ahead, self.visits.pop)) if ahead else None

    def _lost(self, time_s: float) -> Event | None:
        return DroneLost(time_s, self._drawn(self.drones, self.drones.remove)) if len(self.drones) > 1 else None

    def _late(self, time_s: float) -> Event | None:
        if not self.punctual:
            return None
        drone = self._drawn(self.punctual, self.punctual.remove)
        return DroneLate(0.0, drone, float(self.rng.uniform(0.1, 1.0)) * self.settings.most_late_s)

    def _gust(self, time_s: float) -> Event:
        angle, speed = float(self.rng.uniform(0.0, 2.0 * math.pi)), self.settings.gust_mps
        begin_s = max(time_s, self.calm_s)
        self.calm_s = begin_s + self.settings.gust_s
        return Gust(begin_s, self.settings.gust_s, (speed * math.cos(angle), speed * math.sin(angle), 0.0))

    def _drawn(self, names: list[str], strike_off: Callable[[str], object]) -> str:
        name = names[int(self.rng.integers(len(names)))]
        strike_off(name)
        return name


def _moves(scene: Scene, drone: str) -> bool:
    """Whether a drone is in motion from the beginning."""
    record = next(record for record in scene.drones if record.id == drone)
    return any(record.velocity) or any(record.acceleration)


def random_task(scene: Scene, name: str, rng: np.random.Generator) -> Task | None:
    """A task at a random place that is valid in the scene; None if none was found."""
    for _ in range(MOST_DRAWS):
        x, y, z = np.round(rng.uniform(scene.bounds.lower, scene.bounds.upper), 3).tolist()
        try:
            scene.replace(tasks=(*scene.tasks, task := Task(name, (x, y, z))))
        except SceneError:
            continue
        return task
    return None
