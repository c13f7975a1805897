"""A plan flown in PyBullet, and changed in the air: replanned, handed over to the new plan, flown on.

The old plan is flown until the swap, and for good where no certified plan comes of a change. Drones keep their physical
states through a swap; a lost drone leaves the world at once, where it is, and falls on nobody.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from flockopt.certificate import Plan
from flockopt.certificate.case import check_names
from flockopt.planning.handover import Changes
from flockopt.planning.replan import FREEZE_S, Replanned
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel
from sim.mission import flying, orders
from sim.mission.events import Event, TaskRemoved
from sim.mission.execution import Execution
from sim.mission.state import MissionState, MissionTerms, launch
from sim.mission.stitching import stitched
from sim.mission.takeoff import require_certified
from sim.mission.wind import Gust, Wind, check_felt
from sim.physics.settings import FlightSettings

__all__ = ["Mission", "MissionOutcome"]

#: How often the fleet sets off again, after it has come to its end, for tasks that are still open.
MOST_RETURNS = 3


@dataclass(frozen=True)
class MissionOutcome:
    """What came of a mission.

    Attributes:
        flight: The record; its `measures` say how well it was flown.
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
        state: How it stands.

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
        settings = settings or FlightSettings()
        if wind:
            check_felt(settings)
        terms = MissionTerms(scene, settings, seed, tracking_margin_m, freeze_s, gui)
        self.state: MissionState = launch(terms, plan)
        self.state.wind.extend(wind)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Shut the world down."""
        self.state.swarm.close()

    def advance(self, until_s: float) -> None:
        """Fly on to the first whole step at or after a moment of the mission."""
        flying.advance(self.state, until_s)

    def replan(self, changes: Changes) -> Replanned:
        """Answer what has happened, from now on: see `sim.mission.orders.carry_out`."""
        return orders.carry_out(self.state, changes)

    def strike(self, event: Event) -> Replanned | None:
        """Let an event happen now: the answer to it, or None if it calls for none.

        Raises:
            SettingsError: If it names what is not there, leaves nobody to fly, or is a gust in a world without drag.
            SceneError: If a new task is not valid.
        """
        if isinstance(event, Gust):
            self.blow(event)
            return None
        if isinstance(event, TaskRemoved) and event.task in self.state.served:
            return None
        return self.replan(event.changes)

    def blow(self, wind: Wind) -> None:
        """Add to what blows.

        Raises:
            SettingsError: If the settings leave out drag, through which air is felt.
        """
        check_felt(self.state.terms.settings)
        self.state.wind.append(wind)

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
            flying.fly_out(self.state)
            if not self.state.open:
                return
            plan = self.replan(Changes()).plan
            if plan.status != Status.CERTIFIED or not any(plan.routes.values()):
                return

    def finish(self) -> MissionOutcome:
        """Fly the plan, or the one that is pending, to its end and a little longer, and measure all of the flight."""
        flying.fly_out(self.state)
        return _outcome(self.state)


def _outcome(state: MissionState) -> MissionOutcome:
    recording, unserved = state.recording, state.unserved
    flights = {drone: flight for drone, legs in state.legs.items() if (flight := stitched(legs)) is not None}
    execution = Execution(
        _flown_scene(state), flights, state.terms.settings, recording.times, recording.states, tuple(state.touches),
        state.swarm.energy, state.cpu_s,
    )  # fmt: skip
    unexplained = tuple(task for task in state.open if task not in unserved)
    return MissionOutcome(execution, tuple(state.answers), tuple(state.swapped), unserved, unexplained)


def _flown_scene(state: MissionState) -> Scene:
    """The first scene with all tasks that were wanted."""
    first, ledger = state.terms.scene, state.ledger
    tasks = tuple(task for name, task in ledger.tasks.items() if name not in ledger.removed)
    return first if tasks == first.tasks else first.replace(tasks=tasks)
