"""Orders to a mission: changes checked, answered by a new plan from flight, and taken or refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from flockopt.errors import SettingsError
from flockopt.planning.handover import Changes, check_added, too_near
from flockopt.planning.replan import Replanned, replan
from flockopt.records.status import Status
from sim.mission.flying import end_leg, follow, swap_if_due
from sim.mission.state import MissionState

__all__ = ["carry_out"]


def carry_out(state: MissionState, changes: Changes) -> Replanned:
    """Answer what has happened, from now on.

    A certified answer is pending until its swap; if another change comes before, one answer to both takes its place. Tasks
    that were left out or missed before are tried again. Any other answer is refused: the old plan is flown on.

    Args:
        state: The mission; a change that cannot be leaves it as it is.
        changes: What has happened just now; ``missed`` is known here and may be left empty.

    Raises:
        SettingsError: If a change names what is not there, or leaves nobody to fly.
        SceneError: If a new task is not valid.
    """
    _check(state, changes)
    terms, ledger = state.terms, state.ledger.after(changes, state.now_s)
    freeze_s = 0.0 if state.recording.step == 0 and _stands_still(state) else terms.freeze_s
    asked = ledger.changes(state.scene, state.now_s)
    hopeless = too_near(state.scene, state.scene.drones, asked.added)
    asked = replace(asked, added=tuple(task for task in asked.added if task.id not in hopeless))
    clock_s = max(state.now_s - state.begun_s, 0.0)  # a plan may be swapped in a hair before its moment
    answer = replan(
        state.scene, state.plan, clock_s, asked, seed=terms.seed, freeze_s=freeze_s,
        tracking_margin_m=terms.tracking_margin_m, airborne=_airborne(state),
    )  # fmt: skip
    ledger.reasons |= hopeless
    state.ledger = ledger
    _lose(state, changes.lost)
    state.answers.append(answer)
    if answer.plan.status == Status.CERTIFIED:
        state.pending = answer
        swap_if_due(state)
    else:
        state.ledger.refuse(hopeless | answer.unserved, "no certified plan that serves it was found from flight")
    return answer


def _check(state: MissionState, changes: Changes) -> None:
    tasks, drones = set(state.ledger.tasks), set(state.swarm.ids)
    check_added(state.terms.scene.replace(tasks=()), changes.added)  # for the fleet that took off, not for what is left of it
    for field, known in (("removed", tasks), ("lost", drones), ("late", drones)):
        for name in getattr(changes, field):
            if name not in known:
                raise SettingsError(field, f"names {name!r}", "must name what is there", "correct its spelling")
    for task in changes.added:
        if task.id in tasks:
            raise SettingsError("added", f"names {task.id!r} again", "ids must be new", "choose another id")
    if drones <= set(changes.lost):
        raise SettingsError("lost", "leaves no drone", "somebody must be left to fly", "there is nothing to plan")


def _airborne(state: MissionState) -> set[str]:
    """Ids of drones that have had a flight in any plan so far."""
    return {drone for drone, legs in state.legs.items() if any(leg.flight is not None for leg in legs)}


def _stands_still(state: MissionState) -> bool:
    return not any(any(drone.velocity) or any(drone.acceleration) for drone in state.scene.drones)


def _lose(state: MissionState, lost: Sequence[str]) -> None:
    """Take lost drones out of the world; the others fly the plan on."""
    if lost:
        for drone in lost:
            end_leg(state, drone, state.now_s)
        state.swarm.lose(lost)
        follow(state)
