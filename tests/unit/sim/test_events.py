"""Schedules of disturbances: seeded, possible, and valid in the scene."""

from __future__ import annotations

import numpy as np
import pytest

from flockopt import SettingsError, generate, plan
from sim.mission import events as events_module
from sim.mission.events import KINDS, DroneLate, DroneLost, EventSettings, TaskAdded, TaskRemoved, schedule
from sim.mission.wind import Gust
from tests.flights import drone, make_scene

TYPES = {"added": TaskAdded, "removed": TaskRemoved, "lost": DroneLost, "late": DroneLate, "gust": Gust}


@pytest.fixture(scope="module")
def flying():
    scene = generate("forest", drones=4, tasks=8, seed=2)
    return scene, plan(scene, bound="fast")


def test_the_same_seed_gives_the_same_events_and_others_give_others(flying):
    assert schedule(*flying, 3) == schedule(*flying, 3)
    assert len({schedule(*flying, seed) for seed in range(6)}) == 6


def test_events_are_in_order_and_within_the_flight(flying):
    scene, made = flying
    for seed in range(30):
        events = schedule(scene, made, seed, EventSettings(8, within=0.5))
        times = [event.time_s for event in events]
        assert len(events) == 8
        assert times == sorted(times)
        assert times[0] >= 0.0
        assert times[-1] <= 0.5 * made.cost.makespan + 8 * EventSettings().gust_s


def test_every_event_is_possible(flying):
    scene, made = flying
    visits = {visit.task: visit.time for flight in made.flights.values() for visit in flight.visits}
    seen = set()
    for seed in range(60):
        events = schedule(scene, made, seed, EventSettings(9))
        seen |= {type(event) for event in events}
        lost = [event.drone for event in events if isinstance(event, DroneLost)]
        removed = [event.task for event in events if isinstance(event, TaskRemoved)]
        assert len(set(lost)) == len(lost) < scene.num_drones
        assert len(set(removed)) == len(removed)
        for event in events:
            if isinstance(event, TaskRemoved):
                assert visits[event.task] > event.time_s
            if isinstance(event, DroneLate):
                assert event.time_s == 0.0 < event.seconds
            if isinstance(event, TaskAdded):
                scene.replace(tasks=(*scene.tasks, event.task))  # raises where it is not valid
    assert seen == set(TYPES.values())


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_kinds_asked_for_happen(flying, kind):
    assert {type(event) for event in schedule(*flying, 1, EventSettings(3, (kind,)))} == {TYPES[kind]}


def test_what_cannot_happen_any_more_is_an_error(monkeypatch):
    scene = make_scene([drone(0, (1, 1, 1))], [(9, 1, 1)])
    made = plan(scene, bound="fast")
    with pytest.raises(SettingsError, match="kinds are lost"):
        schedule(scene, made, 0, EventSettings(1, ("lost",)))
    monkeypatch.setattr(events_module, "MOST_DRAWS", 0)
    with pytest.raises(SettingsError, match="kinds are added"):
        schedule(scene, made, 0, EventSettings(1, ("added",)))


def test_new_tasks_have_names_of_their_own():
    scene = generate("forest", drones=2, tasks=2, seed=0)
    scene = scene.replace(tasks=tuple(type(task)(f"new{j}", task.position) for j, task in enumerate(scene.tasks)))
    names = [event.task.id for event in schedule(scene, plan(scene, bound="fast"), 0, EventSettings(3, ("added",)))]
    assert not {task.id for task in scene.tasks} & set(names)
    assert len(set(names)) == 3


def test_a_gust_swells_and_dies_away():
    gust = Gust(2.0, 1.0, (3.0, 0.0, -1.0))
    np.testing.assert_array_equal(gust(2.0), 0.0)
    np.testing.assert_allclose(gust(2.25), [1.5, 0.0, -0.5])
    np.testing.assert_allclose(gust(2.5), [3.0, 0.0, -1.0])
    np.testing.assert_array_equal(gust(3.1), 0.0)


def test_gusts_do_not_add_up(flying):
    for seed in range(10):
        gusts = schedule(*flying, seed, EventSettings(12, ("gust",), gust_mps=3.0))
        for moment in np.linspace(0.0, 20.0, 301):
            assert np.linalg.norm(sum(gust(moment) for gust in gusts)) <= 3.0 + 1e-9


@pytest.mark.parametrize(
    ("field", "value"),
    [("number", 0), ("number", 1.5), ("within", 0.0), ("gust_mps", float("nan")), ("gust_s", -1.0), ("most_late_s", 0)],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(SettingsError, match=f"^{field} is {value!r}"):
        EventSettings(**{field: value})


@pytest.mark.parametrize("kinds", [(), ("lost", "quake")])
def test_unknown_kinds_are_named(kinds):
    with pytest.raises(SettingsError, match=r"^kinds hold"):
        EventSettings(kinds=kinds)
