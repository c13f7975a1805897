"""A mission in time: its plan flown step by step, visits judged when they are over, the next plan swapped in when it is due."""

from __future__ import annotations

import math
import time

from sim.mission.measures import worst_distance
from sim.mission.state import MissionState
from sim.mission.stitching import Leg
from sim.mission.wind import total_wind
from sim.physics.reference import pack_flights

__all__ = ["advance", "end_leg", "fly_out", "follow", "swap_if_due"]

#: Parts of a step by which a moment may lie behind it and still count as that step.
STEP_TOLERANCE = 1e-6


def advance(state: MissionState, until_s: float) -> None:
    """Fly on to the first whole step at or after a moment of the mission."""
    _fly(state, _step_at(state, until_s))


def fly_out(state: MissionState) -> None:
    """Fly the plan, or the one that is pending, to its end and a little longer."""
    if state.pending is not None:
        advance(state, state.swap_s)
    settings = state.terms.settings
    _fly(state, max(1, math.ceil((state.end_s + settings.settle_s) * settings.physics_hz)))


def _fly(state: MissionState, last: int) -> None:
    """Fly on to a step, with a swap on the way if it is due."""
    while state.recording.step < last:
        _fly_plan(state, last if state.pending is None else min(last, _step_at(state, state.swap_s)))
        swap_if_due(state)


def _step_at(state: MissionState, time_s: float) -> int:
    """The first step at or after a moment."""
    return math.ceil(time_s * state.terms.settings.physics_hz - STEP_TOLERANCE)


def _fly_plan(state: MissionState, last: int) -> None:
    """Fly the present plan on to a step."""
    terms, recording, swarm, step_s = state.terms, state.recording, state.swarm, state.terms.step_s
    recording.make_room(last)
    columns = slice(None) if len(swarm.ids) == terms.scene.num_drones else swarm.columns
    first, wall, cpu = recording.step, time.monotonic(), time.thread_time()
    for step in range(first, last):
        now_s = step * step_s
        air = total_wind(state.wind, now_s)
        state.touches += swarm.step(state.reference, now_s - state.begun_s, air, (step + 1) * step_s)
        recording.add(swarm.state, columns)
        if terms.is_shown:
            time.sleep(max(0.0, wall + (step + 1 - first) * step_s - time.monotonic()))
    state.cpu_s += time.thread_time() - cpu
    _judge_visits(state)


def _judge_visits(state: MissionState) -> None:
    """Judge the visits that are over."""
    terms, ledger = state.terms, state.ledger
    for due in [due for due in ledger.due if due.end_s <= state.now_s]:
        times, track = state.recording.since(due.begin_s, terms.columns[due.drone])
        away = worst_distance(times, track, due.begin_s, due.end_s, ledger.tasks[due.task].position)
        ledger.judge(due, away, terms.settings.service_radius)


def swap_if_due(state: MissionState) -> None:
    """Fly the pending plan from now on, if its moment has come."""
    answer, swap_s = state.pending, state.swap_s
    if answer is None or state.recording.step < _step_at(state, swap_s):
        return
    for drone in state.swarm.ids:
        end_leg(state, drone, swap_s)
        state.legs[drone].append(Leg(answer.plan.flights.get(drone), swap_s))
    state.scene, state.plan, state.begun_s, state.pending = answer.scene, answer.plan, swap_s, None
    state.swapped.append(answer)
    state.ledger.expect(answer.plan, swap_s)
    state.ledger.reasons |= answer.unserved
    follow(state)


def end_leg(state: MissionState, drone: str, until_s: float) -> None:
    """A drone follows the present plan no longer than until a moment of the mission."""
    last = state.legs[drone][-1]
    state.legs[drone][-1] = Leg(last.flight, last.begin_s, until_s)


def follow(state: MissionState) -> None:
    """Let every drone that is left follow its part of the plan."""
    drones = {drone.id: drone for drone in state.scene.drones}
    state.reference = pack_flights([drones[name] for name in state.swarm.ids], state.plan.flights)
