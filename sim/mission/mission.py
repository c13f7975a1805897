"""A plan flown in PyBullet, and changed in the air: replanned, handed over to the new plan, flown on.

The old plan is flown until the swap, and for good where no certified plan comes of a change. Drones keep their physical
states through a swap; a lost drone leaves the world at once, where it is, and falls on nobody.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self, TypeAlias

import numpy as np

from flockopt.certificate import Plan
from flockopt.certificate.case import check_names
from flockopt.errors import SettingsError
from flockopt.flights import Flight
from flockopt.planning.handover import Changes, too_near
from flockopt.planning.replan import FREEZE_S, Replanned, replan
from flockopt.records.arrays import FloatArray
from flockopt.scene import Scene
from flockopt.travel import Travel
from sim.mission.events import Event, Gust, TaskRemoved
from sim.mission.execution import Execution
from sim.mission.ledger import Ledger
from sim.mission.measures import worst_distance
from sim.mission.recording import Recording
from sim.mission.stitching import Leg, stitched
from sim.mission.takeoff import require_certified
from sim.physics.reference import pack_flights
from sim.physics.settings import FlightSettings
from sim.physics.swarm import Swarm
from sim.physics.world import Touch

__all__ = ["Mission", "MissionOutcome", "Wind"]

#: Velocity of the air, (3,) m/s, at a time of the mission, s.
Wind: TypeAlias = Callable[[float], FloatArray]

#: Parts of a step by which a moment may lie behind it and still count as that step.
STEP_TOLERANCE = 1e-6

#: How often the fleet sets off again, after it has come to its end, for tasks that are still open.
MOST_RETURNS = 3


@dataclass(frozen=True)
class MissionOutcome:
    """What came of a mission.

    Attributes:
        flight: The record; its `outcome` holds the measures.
        answers: The answer to every replanning, in order.
        swapped: Those of them that were flown.
        unserved: Reasons by id of the tasks that were wanted and not served.
        unexplained: Ids of tasks that were wanted, not served, and for which there is no reason.
    """

    flight: Execution
    answers: tuple[Replanned, ...]
    swapped: tuple[Replanned, ...]
    unserved: dict[str, str]
    unexplained: tuple[str, ...]


class Mission:
    """A fleet in flight; to be used in a ``with`` statement.

    Args:
        scene: The scene.
        plan: A plan for it. What it says of itself is not believed: it is certified anew.
        settings: How to fly; the defaults otherwise.
        travel: The scene's travel, if it is at hand; the judge computes it otherwise.
        wind: What blows; the sum of all counts, and controllers do not know of it.
        seed: Of the searches that replanning takes.
        tracking_margin_m: Room that new plans keep for tracking errors, metres, as in `flockopt.plan`.
        freeze_s: How long the old plan is flown on after a change, seconds: what replanning may take.
        force: Fly the plan even if a clause of its certificate fails.
        gui: Whether to open PyBullet's window and fly no faster than real time.

    Attributes:
        scene: What the plan now flown was made for: drones from its beginning on, tasks that were open then.
        plan: The plan now flown.
        begun_s: When it was swapped in, seconds of the mission.
        pending: The certified answer that is to be swapped in next, or None.
        wind: What blows.
        answers: The answer to every replanning.
        swapped: Those of them that have been swapped in.
        touches: Contacts so far.

    Raises:
        PlanError: If the plan is for another scene, or does not hold and ``force`` is not set.
        SettingsError: If the controller does not fly the vehicle.
        MissingExtra: If PyBullet is not installed.
    """

    def __init__(
        self, scene: Scene, plan: Plan, settings: FlightSettings | None = None, *, travel: Travel | None = None,
        wind: Sequence[Wind] = (), seed: int = 0, tracking_margin_m: float = 0.0, freeze_s: float = FREEZE_S,
        force: bool = False, gui: bool = False,
    ) -> None:  # fmt: skip
        check_names(scene, plan)
        if not force:
            require_certified(scene, plan, travel)
        self.settings = settings or FlightSettings()
        self.scene, self.plan, self.begun_s = scene, plan, 0.0
        self.pending: Replanned | None = None
        self.answers, self.swapped = list[Replanned](), list[Replanned]()
        self.touches: list[Touch] = []
        self.wind: list[Wind] = []
        for blow in wind:
            self.blow(blow)
        self._first, self._seed, self._margin_m, self._freeze_s, self._is_shown = scene, seed, tracking_margin_m, freeze_s, gui
        self._ledger = Ledger(scene, plan)
        self._legs: dict[str, list[Leg]] = {drone.id: [Leg(plan.flights.get(drone.id))] for drone in scene.drones}
        self._reference = pack_flights(scene.drones, plan.flights)
        self._swarm = Swarm(scene, self.settings, gui=gui)
        self._columns = {drone.id: column for column, drone in enumerate(scene.drones)}
        self._step_s, self._cpu_s = 1.0 / self.settings.physics_hz, 0.0
        self._recording = Recording(self._swarm.state, self._step_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Shut the world down."""
        self._swarm.close()

    # -- how it stands --------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        """Seconds since the beginning."""
        return self._recording.now_s

    @property
    def swap_s(self) -> float:
        """When the pending plan is swapped in, seconds of the mission; infinite without one."""
        return math.inf if self.pending is None else self.begun_s + self.pending.swap_s

    @property
    def end_s(self) -> float:
        """When the last flight of the plan now flown comes to its end, seconds of the mission."""
        return self.begun_s + max((flight.curve.end_time for flight in self.plan.flights.values()), default=0.0)

    @property
    def states(self) -> dict[str, FloatArray]:
        """(17,) by id of every drone that is not lost, columns as in `sim.physics.fleet`."""
        return dict(zip(self._swarm.ids, self._swarm.state.copy(), strict=True))

    def positions(self) -> dict[str, FloatArray]:
        """(3,) m by id of every drone that is not lost."""
        return {drone: state[:3] for drone, state in self.states.items()}

    @property
    def swaps(self) -> int:
        """How often the plan has been changed."""
        return len(self.swapped)

    @property
    def serviced(self) -> tuple[str, ...]:
        """Ids of the tasks served so far."""
        return tuple(self._ledger.served)

    @property
    def open(self) -> tuple[str, ...]:
        """Ids of the tasks that are wanted and not served yet."""
        return self._ledger.open

    @property
    def unserved(self) -> dict[str, str]:
        """Reasons by id of the open tasks that nobody is on the way to, as far as they are known."""
        return self._ledger.unserved(self.settings.service_radius)

    # -- flying ---------------------------------------------------------------------------------------------

    def advance(self, until_s: float) -> None:
        """Fly on to the first whole step at or after a moment of the mission."""
        self._fly(self._step_at(until_s))

    def finish(self) -> MissionOutcome:
        """Fly the plan, or the one that is pending, to its end and a little longer, and measure all of the flight."""
        self._fly_out()
        recording = self._recording
        flight = Execution(
            self._flown_scene(), self._flights(), self.settings, recording.times, recording.states, tuple(self.touches),
            self._swarm.energy, self._cpu_s,
        )  # fmt: skip
        unserved = self.unserved
        unexplained = tuple(task for task in self.open if task not in unserved)
        return MissionOutcome(flight, tuple(self.answers), tuple(self.swapped), unserved, unexplained)

    def fly(self, events: Sequence[Event]) -> MissionOutcome:
        """Fly to the end, answer what happens on the way, and fly again for tasks that are then still open.

        Args:
            events: What happens, in order of time; with none, the plan is flown and that is all.
        """
        for event in events:
            self.advance(event.time_s)
            self.strike(event)
        if events:
            self.serve_rest()
        return self.finish()

    def serve_rest(self) -> None:
        """Fly to the plan's end, and set off again for tasks that are still open as long as that serves any of them."""
        for _ in range(MOST_RETURNS):
            self._fly_out()
            if not self.open:
                return
            plan = self.replan(Changes()).plan
            if plan.status != "certified" or not any(plan.routes.values()):
                return

    def _fly_out(self) -> None:
        if self.pending is not None:
            self.advance(self.swap_s)
        self._fly(max(1, math.ceil((self.end_s + self.settings.settle_s) * self.settings.physics_hz)))

    def _fly(self, last: int) -> None:
        """Fly on to a step, with a swap on the way if it is due."""
        while self._recording.step < last:
            self._fly_plan(last if self.pending is None else min(last, self._step_at(self.swap_s)))
            self._swap_if_due()

    def _step_at(self, time_s: float) -> int:
        """The first step at or after a moment."""
        return math.ceil(time_s * self.settings.physics_hz - STEP_TOLERANCE)

    def _fly_plan(self, last: int) -> None:
        """Fly the present plan on to a step."""
        recording, swarm, step_s = self._recording, self._swarm, self._step_s
        recording.make_room(last)
        columns = slice(None) if len(swarm.ids) == self._first.num_drones else swarm.columns
        first, wall, cpu = recording.step, time.monotonic(), time.thread_time()
        for step in range(first, last):
            now_s = step * step_s
            air = np.sum([blow(now_s) for blow in self.wind], axis=0) if self.wind else None
            self.touches += swarm.step(self._reference, now_s - self.begun_s, air, (step + 1) * step_s)
            recording.add(swarm.state, columns)
            if self._is_shown:
                time.sleep(max(0.0, wall + (step + 1 - first) * step_s - time.monotonic()))
        self._cpu_s += time.thread_time() - cpu
        self._judge_visits()

    def _judge_visits(self) -> None:
        """Judge the visits that are over."""
        for due in [due for due in self._ledger.due if due.end_s <= self.now_s]:
            times, track = self._recording.since(due.begin_s, self._columns[due.drone])
            away = worst_distance(times, track, due.begin_s, due.end_s, self._ledger.tasks[due.task].position)
            self._ledger.judge(due, away, self.settings.service_radius)

    # -- changing the plan ----------------------------------------------------------------------------------

    def replan(self, changes: Changes) -> Replanned:
        """Answer what has happened, from now on.

        A certified answer is pending until its swap; if another change comes before, one answer to both takes its place.
        Tasks that were left out or missed before are tried again. Any other answer is refused: the old plan is flown on.

        Args:
            changes: What has happened just now; ``missed`` is known here and may be left empty.

        Raises:
            SettingsError: If a change names what is not there, or leaves nobody to fly.
            SceneError: If a new task is not valid.
        """
        self._check(changes)
        ledger = self._ledger.after(changes, self.now_s)
        freeze_s = 0.0 if self._recording.step == 0 and self._stands_still() else self._freeze_s
        asked = ledger.changes(self.scene, self.now_s + freeze_s)
        hopeless = too_near(self.scene, self.scene.drones, asked.added)
        asked = replace(asked, added=tuple(task for task in asked.added if task.id not in hopeless))
        clock_s = max(self.now_s - self.begun_s, 0.0)  # a plan may be swapped in a hair before its moment
        answer = replan(
            self.scene, self.plan, clock_s, asked, seed=self._seed, freeze_s=freeze_s,
            tracking_margin_m=self._margin_m, airborne=self._airborne(),
        )  # fmt: skip
        ledger.reasons |= hopeless
        self._ledger = ledger
        self._lose(changes.lost)
        self.answers.append(answer)
        if answer.plan.status == "certified":
            self.pending = answer
            self._swap_if_due()
        else:
            self._ledger.refuse(hopeless | answer.unserved, "no certified plan that serves it was found from flight")
        return answer

    def strike(self, event: Event) -> Replanned | None:
        """Let an event happen now: the answer to it, or None if it calls for none.

        Raises:
            SettingsError: If it names what is not there, leaves nobody to fly, or is a gust in a world without drag.
            SceneError: If a new task is not valid.
        """
        if isinstance(event, Gust):
            self.blow(event)
            return None
        if isinstance(event, TaskRemoved) and event.task in self.serviced:
            return None
        return self.replan(event.changes)

    def blow(self, wind: Wind) -> None:
        """Add to what blows.

        Raises:
            SettingsError: If the settings leave out drag, through which air is felt.
        """
        if not self.settings.has_drag:
            raise SettingsError("wind", "blows", "needs has_drag, through which air is felt", "set it or leave out the wind")
        self.wind.append(wind)

    def _check(self, changes: Changes) -> None:
        self._first.replace(tasks=changes.added)  # for the fleet that took off, not for what is left of it
        known = {"removed": set(self._ledger.tasks), "lost": set(self._swarm.ids), "late": set(self._swarm.ids)}
        for field, names in known.items():
            for name in getattr(changes, field):
                if name not in names:
                    raise SettingsError(field, f"names {name!r}", "must name what is there", "correct its spelling")
        for task in changes.added:
            if task.id in self._ledger.tasks:
                raise SettingsError("added", f"names {task.id!r} again", "ids must be new", "choose another id")
        if set(self._swarm.ids) <= set(changes.lost):
            raise SettingsError("lost", "leaves no drone", "somebody must be left to fly", "there is nothing to plan")

    def _airborne(self) -> set[str]:
        """Ids of drones that have had a flight in any plan so far."""
        return {drone for drone, legs in self._legs.items() if any(leg.flight is not None for leg in legs)}

    def _stands_still(self) -> bool:
        return not any(any(drone.velocity) or any(drone.acceleration) for drone in self.scene.drones)

    def _lose(self, lost: Sequence[str]) -> None:
        """Take lost drones out of the world; the others fly the plan on."""
        if lost:
            for drone in lost:
                self._end_leg(drone, self.now_s)
            self._swarm.lose(lost)
            self._follow()

    def _swap_if_due(self) -> None:
        """Fly the pending plan from now on, if its moment has come."""
        answer, swap_s = self.pending, self.swap_s
        if answer is None or self._recording.step < self._step_at(swap_s):
            return
        for drone in self._swarm.ids:
            self._end_leg(drone, swap_s)
            self._legs[drone].append(Leg(answer.plan.flights.get(drone), swap_s))
        self.scene, self.plan, self.begun_s, self.pending = answer.scene, answer.plan, swap_s, None
        self.swapped.append(answer)
        self._ledger.expect(answer.plan, swap_s)
        self._ledger.reasons |= answer.unserved
        self._follow()

    def _end_leg(self, drone: str, until_s: float) -> None:
        last = self._legs[drone][-1]
        self._legs[drone][-1] = Leg(last.flight, last.begin_s, until_s)

    def _follow(self) -> None:
        """Let every drone that is left follow its part of the plan."""
        drones = {drone.id: drone for drone in self.scene.drones}
        self._reference = pack_flights([drones[name] for name in self._swarm.ids], self.plan.flights)

    # -- the whole ------------------------------------------------------------------------------------------

    def _flown_scene(self) -> Scene:
        """The first scene with all tasks that were wanted."""
        tasks = tuple(task for name, task in self._ledger.tasks.items() if name not in self._ledger.removed)
        return self._first if tasks == self._first.tasks else self._first.replace(tasks=tasks)

    def _flights(self) -> dict[str, Flight]:
        return {drone: flight for drone, legs in self._legs.items() if (flight := stitched(legs)) is not None}
