"""A fleet in flight that takes orders: all that the page shows and its buttons do, without the page.

Orders may come from any thread. The clock stands still while an order is answered; a fleet whose clock cannot wait has
`flockopt.planning.replan.FREEZE_S` seconds for it, since until then it flies the old plan anyway.
"""

from __future__ import annotations

import math
from collections import deque
from threading import RLock
from types import TracebackType
from typing import Literal, Self

import numpy as np

from flockopt.certificate import Plan
from flockopt.errors import SceneError, SettingsError
from flockopt.planning.replan import Changes
from flockopt.records import checks
from flockopt.records.arrays import FloatArray
from flockopt.scene import Point, Scene, Task
from sim.live.view import TaskView, View
from sim.mission.mission import Mission
from sim.mission.wind import Gust
from sim.physics.settings import FlightSettings

__all__ = ["MOST_SPEED", "Session"]

#: Seconds flown for each second on the wall, at most: whoever watches waits while a tick is flown, and a tick is short.
MOST_SPEED = 8.0

#: Seconds on the wall that one call of `Session.tick` makes up for at most; after longer ones the flight just goes on.
LONGEST_TICK_S = 0.1

#: How long a gust is felt after it has blown, seconds.
CALMING_S = 2.0

#: How many lines of the log are kept.
LOG_LINES = 100

#: Seconds between the points of the ways ahead.
WAY_STEP_S = 0.05


class Session:
    """A flight that goes on as the wall clock does and takes orders; to be used in a ``with`` statement.

    Args:
        scene: The scene.
        plan: A plan for it, which has to be certified.
        settings: How to fly; the defaults otherwise.
        seed: Of the searches that replanning takes.
        speed: Seconds flown for each second on the wall.
        tracking_margin_m: Room that new plans keep for tracking errors, metres.

    Raises:
        PlanError: If the plan is for another scene or does not hold.
        SettingsError: If the speed is not positive, or above `MOST_SPEED`.
        MissingExtra: If PyBullet is not installed.
    """

    def __init__(
        self, scene: Scene, plan: Plan, settings: FlightSettings | None = None, *, seed: int = 0, speed: float = 1.0,
        tracking_margin_m: float = 0.0,
    ) -> None:  # fmt: skip
        self.scene, self.is_paused, self.speed = scene, False, speed
        self._mission = Mission(scene, plan, settings, seed=seed, tracking_margin_m=tracking_margin_m)
        self._lock = RLock()
        self._tasks = {task.id: task for task in scene.tasks}
        self._lost: dict[str, FloatArray] = {}
        self._num_added, self._calm_s, self._due_s = 0, 0.0, 0.0
        self._log: deque[str] = deque(maxlen=LOG_LINES)
        self._note(f"took off: {plan.status}, {len(plan.unserved)} tasks left out")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Shut the world down."""
        with self._lock:
            self._mission.close()

    # -- time -----------------------------------------------------------------------------------------------

    @property
    def speed(self) -> float:
        """Seconds flown for each second on the wall, above 0 and at most `MOST_SPEED`."""
        return self._speed

    @speed.setter
    def speed(self, value: float) -> None:
        speed = checks.number(SettingsError, "speed", value, above=0.0)
        if speed > MOST_SPEED:
            rule = f"must be at most {MOST_SPEED:g}, so that the page is not kept waiting"
            raise SettingsError("speed", f"is {speed:g}", rule, "choose less; python -m sim.fly flies as fast as it can")
        self._speed = speed

    @property
    def is_waiting(self) -> bool:
        """Whether all flights are at their end and nothing is to come: the clock then stands until the next order."""
        state = self._mission.state
        rest_s = max(state.end_s + state.terms.settings.settle_s, self._calm_s)
        return state.pending is None and state.now_s >= rest_s

    def tick(self, wall_s: float) -> None:
        """Fly on by what ``wall_s`` seconds on the wall amount to."""
        with self._lock:
            if self.is_paused or self.is_waiting:
                return
            state = self._mission.state
            before, swaps = set(state.served), len(state.swapped)
            # The mission flies whole steps; what it is ahead by must not add up.
            self._due_s = self._due_s + self._speed * min(wall_s, LONGEST_TICK_S)
            self._mission.advance(self._due_s)
            if len(state.swapped) > swaps:
                self._note("the new plan is flown")
            for task in state.served:
                if task not in before:
                    self._note(f"{task} is served")

    # -- orders ---------------------------------------------------------------------------------------------

    def add_task(self, position: Point, service_time: float = 0.0) -> str:
        """Ask for one more visit; returns the new task's id.

        Raises:
            SceneError: If no drone may hover there.
        """
        with self._lock:
            task = Task(self._new_name(), position, service_time=service_time)
            try:
                self.scene.replace(tasks=(task,))
            except SceneError as fault:
                raise type(fault)(fault.field.replace("tasks[0]", "the task"), fault.value, fault.rule, fault.mend) from None
            self._order(f"{task.id} is wanted at {_words(task.position)}", Changes(added=(task,)))
            self._tasks[task.id] = task
            return task.id

    def _new_name(self) -> str:
        names = {task.id for task in self.scene.tasks}
        while True:
            self._num_added += 1
            if f"n{self._num_added}" not in names:
                return f"n{self._num_added}"

    def remove_task(self, task: str) -> None:
        """Withdraw a task.

        Raises:
            SettingsError: If it is not open.
        """
        with self._lock:
            if task not in self._mission.state.open:
                raise SettingsError("task", f"is {task!r}", "must be one that is still to be served", "choose an open one")
            self._order(f"{task} is withdrawn", Changes(removed=(task,)))
            del self._tasks[task]

    def kill(self, drone: str) -> None:
        """Take a drone out of the air; its tasks go to others.

        Raises:
            SettingsError: If it is not in the air, or the last one.
        """
        with self._lock:
            where = self._mission.state.positions.get(drone)
            self._order(f"{drone} is lost", Changes(lost=(drone,)))
            if where is not None:
                self._lost[drone] = where

    def blow(self, velocity: Point, seconds: float = 2.0) -> None:
        """Let the wind blow on all drones, which know nothing of it, from now on.

        Raises:
            SettingsError: If it would blow for no time.
        """
        with self._lock:
            seconds = checks.number(SettingsError, "seconds", seconds, above=0.0)
            gust = Gust(self._mission.state.now_s, seconds, checks.point(SettingsError, "velocity", velocity))
            self._mission.blow(gust)
            self._calm_s = max(self._calm_s, gust.time_s + seconds + CALMING_S)
            self._note(f"a gust of {math.hypot(*gust.velocity):.1f} m/s blows")

    def _order(self, words: str, changes: Changes) -> None:
        answer = self._mission.replan(changes)
        self._note(f"{words}; answered in {1000.0 * answer.seconds:.0f} ms: {answer.strategy} bundles, {answer.plan.status}")
        for task, reason in answer.unserved.items():
            self._note(f"{task} is left out: {reason}")

    def _note(self, words: str) -> None:
        self._log.append(f"{self._mission.state.now_s:7.2f} s  {words}")

    # -- how it stands --------------------------------------------------------------------------------------

    def view(self) -> View:
        """How the session stands now."""
        with self._lock:
            mission = self._mission.state
            state: Literal["flying", "paused", "waiting"] = "flying"
            if self.is_waiting or self.is_paused:
                state = "paused" if self.is_paused else "waiting"
            return View(
                now_s=mission.now_s, state=state, drones=mission.positions, lost=dict(self._lost), tasks=self._task_views(),
                plan=mission.plan, plan_number=len(mission.swapped) + len(self._lost), swap_s=mission.swap_s - mission.now_s,
                answer=mission.answers[-1] if mission.answers else None, contacts=len(mission.touches), log=tuple(self._log),
            )  # fmt: skip

    def _task_views(self) -> tuple[TaskView, ...]:
        mission = self._mission.state
        served, reasons = set(mission.served), mission.unserved
        plan = mission.plan if mission.pending is None else mission.pending.plan
        server = {task: drone for drone, tasks in plan.routes.items() if drone not in self._lost for task in tasks}
        views = []
        for task in self._tasks.values():
            if task.id in served:
                views.append(TaskView(task.id, task.position, "served"))
            elif task.id in reasons:
                views.append(TaskView(task.id, task.position, "left out", reason=reasons[task.id]))
            else:
                views.append(TaskView(task.id, task.position, "open", server.get(task.id)))
        return tuple(views)

    def ways(self) -> dict[str, FloatArray]:
        """(V, 3) m by id: what drones in the air have still ahead of them in the plan now flown."""
        with self._lock:
            mission = self._mission.state
            now_s = mission.now_s - mission.begun_s
            ways = {}
            for drone in mission.positions:
                flight = mission.plan.flights.get(drone)
                if flight is not None and flight.curve.end_time > now_s:
                    begin = max(now_s, flight.curve.start_time)
                    count = 2 + int((flight.curve.end_time - begin) / WAY_STEP_S)
                    ways[drone] = flight.curve(np.linspace(begin, flight.curve.end_time, count))
            return ways


def _words(position: Point) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*position)
