"""Plans changed in the air: what becomes of drones and tasks, and that nothing uncertified is flown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet comes with the extra 'sim'")

from flockopt import Changes, Cylinder, SceneError, SettingsError, Task, certify, plan
from sim.mission import orders
from sim.mission.events import DroneLate, DroneLost, TaskAdded, TaskRemoved
from sim.mission.execute import execute
from sim.mission.mission import Mission
from sim.mission.wind import Gust
from sim.physics.settings import FlightSettings
from tests.flights import drone, make_scene

PILLAR = Cylinder("pillar", (5, 5, 2), 0.6, 4.0)


@pytest.fixture(scope="module")
def flying():
    starts = [(1, 1, 1), (9, 9, 1), (1, 9, 1)]
    tasks = [(9, 2, 2), Task("hold", (5, 8, 2), service_time=1.0), (2, 6, 1.5), (8, 6, 2.5), (4, 3, 3)]
    scene = make_scene([drone(i, start) for i, start in enumerate(starts)], tasks, (PILLAR,))
    return scene, plan(scene, bound="fast")


def longest(made) -> str:
    """The drone with the most tasks ahead."""
    return max(made.routes, key=lambda name: len(made.routes[name]))


def flawless(outcome) -> bool:
    """Everything served or listed, nothing touched, every plan certified by the judge anew."""
    certified = all(certify(answer.scene, answer.plan).certified for answer in outcome.swapped)
    return certified and not outcome.unexplained and not outcome.flight.touches


def test_a_plan_flown_in_portions_is_the_plan_flown_whole(flying):
    with Mission(*flying) as mission:
        for moment in (0.0, 0.001, 1.0, 1.0, 2.718):
            mission.advance(moment)
        outcome = mission.finish()
    whole = execute(*flying)
    np.testing.assert_array_equal(outcome.flight.states, whole.states)
    assert outcome.flight.flights == whole.flights
    assert (outcome.answers, outcome.unserved) == ((), {})


def test_a_lost_drone_leaves_the_world_and_others_serve_its_tasks(flying):
    scene, made = flying
    lost = longest(made)
    with Mission(scene, made) as mission:
        mission.advance(1.0)
        answer = mission.strike(DroneLost(1.0, lost))
        assert answer.plan.status == "certified"
        assert lost not in mission.state.positions
        outcome = mission.finish()
    column = [record.id for record in scene.drones].index(lost)
    there = np.isfinite(outcome.flight.positions[:, column]).all(axis=1)
    assert there.sum() == np.ceil(240 * 1.0) + 1
    assert there[: there.sum()].all()
    assert outcome.flight.measures.completion == 1.0
    assert outcome.flight.measures.max_tracking_error < 0.03
    assert outcome.flight.measures.min_separation > scene.separation - 0.06
    assert outcome.flight.energy[column] > 0.0
    assert flawless(outcome)


def test_what_a_lost_drone_would_have_served_until_the_swap_is_open_again(flying):
    scene, made = flying
    lost = longest(made)
    first = made.flights[lost].visits[0]
    now_s = first.time - 0.1
    with Mission(scene, made) as mission:
        mission.advance(now_s)
        answer = mission.strike(DroneLost(now_s, lost))
        assert answer.swap_s > first.time
        assert first.task in {task.id for task in answer.scene.tasks}
        outcome = mission.finish()
    assert outcome.flight.measures.completion == 1.0
    assert flawless(outcome)


def test_tasks_come_and_go(flying):
    scene, made = flying
    removed = made.flights[longest(made)].visits[-1].task
    with Mission(scene, made) as mission:
        mission.advance(0.5)
        mission.strike(TaskAdded(0.5, Task("new", (6.0, 2.0, 1.0))))
        mission.advance(1.5)
        mission.strike(TaskRemoved(1.5, removed))
        outcome = mission.finish()
        assert mission.strike(TaskRemoved(mission.state.now_s, "new")) is None  # it is served already
    assert outcome.flight.measures.completion == 1.0
    assert set(outcome.flight.measures.served) == {task.id for task in scene.tasks} - {removed} | {"new"}
    assert len(outcome.swapped) == 2
    assert flawless(outcome)


def test_drones_fly_on_through_a_swap(flying):
    scene, made = flying
    with Mission(scene, made) as mission:
        mission.advance(1.0)
        mission.strike(TaskAdded(1.0, Task("new", (6.0, 2.0, 1.0))))
        outcome = mission.finish()
    speeds = np.linalg.norm(np.diff(outcome.flight.velocities, axis=0), axis=2) * 240.0
    assert speeds.max() < 2.0 * max(record.max_acceleration for record in scene.drones)
    assert outcome.flight.measures.max_tracking_error < 0.02
    assert list(outcome.flight.flights) == [record.id for record in scene.drones]


def test_one_answer_to_two_changes_before_the_swap(flying):
    scene, made = flying
    with Mission(scene, made) as mission:
        mission.advance(1.0)
        mission.replan(Changes(lost=(longest(made),)))
        mission.advance(1.2)
        second = mission.replan(Changes(added=(Task("new", (6.0, 2.0, 1.0)),)))
        assert mission.state.pending is second
        assert longest(made) not in second.plan.routes
        outcome = mission.finish()
    assert outcome.swapped == (second,)
    assert "new" in outcome.flight.measures.served
    assert outcome.flight.measures.completion == 1.0
    assert flawless(outcome)


def test_a_drone_that_is_late_stays_where_it_is_until_it_can_set_off(flying):
    scene, made = flying
    late = longest(made)
    with Mission(scene, made) as mission:
        mission.strike(DroneLate(0.0, late, 2.0))
        assert len(mission.state.swapped) == 1  # nobody flies yet, so there is nothing to be flown on
        mission.advance(1.0)
        mission.strike(TaskAdded(1.0, Task("new", (6.0, 2.0, 1.0))))
        mission.advance(1.99)
        away = np.linalg.norm(
            mission.state.positions[late] - next(record.start for record in scene.drones if record.id == late)
        )
        outcome = mission.finish()
    assert away < 1e-3
    assert outcome.flight.measures.completion == 1.0
    assert flawless(outcome)


def test_a_change_without_a_certified_answer_is_refused_and_listed(flying, monkeypatch):
    scene, made = flying
    real = orders.replan

    def uncertified(*arguments, **settings):
        answer = real(*arguments, **settings)
        return replace(answer, plan=replace(answer.plan, status="uncertified"), unserved={})

    monkeypatch.setattr(orders, "replan", uncertified)
    lost = longest(made)
    with Mission(scene, made) as mission:
        mission.advance(1.0)
        mission.strike(TaskAdded(1.0, Task("new", (6.0, 2.0, 1.0))))
        assert "no certified plan" in mission.state.unserved["new"]
        mission.strike(DroneLost(1.0, lost))
        outcome = mission.finish()
    others = {task for name, route in made.routes.items() if name != lost for task in route}
    assert others <= set(outcome.flight.measures.served)
    assert outcome.swapped == ()
    assert set(outcome.unserved) == {"new"} | {task.id for task in scene.tasks} - set(outcome.flight.measures.served)
    assert flawless(outcome)


def test_a_pending_plan_outlives_a_change_that_is_refused(flying, monkeypatch):
    scene, made = flying
    with Mission(scene, made) as mission:
        mission.advance(1.0)
        first = mission.replan(Changes(added=(Task("new", (6.0, 2.0, 1.0)),)))
        real = orders.replan
        monkeypatch.setattr(
            orders,
            "replan",
            lambda *a, **k: replace(real(*a, **k), plan=replace(first.plan, status="uncertified"), unserved={"other": "why"}),
        )
        mission.replan(Changes(added=(Task("other", (3.0, 8.0, 1.0)),)))
        outcome = mission.finish()
    assert outcome.swapped == (first,)
    assert outcome.unserved == {"other": "why"}
    assert "new" in outcome.flight.measures.served


def test_a_pending_plan_is_flown_without_a_drone_lost_meanwhile(flying, monkeypatch):
    scene, made = flying
    real = orders.replan
    with Mission(scene, made) as mission:
        mission.advance(0.5)
        first = mission.replan(Changes(added=(Task("new", (6.0, 2.0, 1.0)),)))
        server = next(name for name, route in first.plan.routes.items() if "new" in route)
        refused = replace(first.plan, status="uncertified")
        monkeypatch.setattr(orders, "replan", lambda *a, **k: replace(real(*a, **k), plan=refused))
        mission.strike(DroneLost(0.5, server))
        outcome = mission.finish()
    assert outcome.swapped == (first,)
    assert "new" in outcome.unserved
    assert set(outcome.unserved) | set(outcome.flight.measures.served) == {task.id for task in scene.tasks} | {"new"}
    assert outcome.unexplained == ()


def test_what_no_capacity_is_left_for_is_listed():
    scene = make_scene([drone(0, (1, 1, 1), 1), drone(1, (1, 9, 1), 1)], [(9, 1, 1), (9, 9, 1)])
    with Mission(scene, plan(scene, bound="fast")) as mission:
        mission.advance(1.0)
        mission.strike(DroneLost(1.0, "d1"))
        mission.serve_rest()
        outcome = mission.finish()
    assert list(outcome.unserved) == ["t1"]
    assert "capacity" in outcome.unserved["t1"] or "full" in outcome.unserved["t1"]
    assert outcome.flight.measures.completion == 0.5
    assert flawless(outcome)


def test_what_only_lost_drones_were_small_enough_for_stays_listed():
    scene = make_scene([drone(0, (1, 1, 1)), drone(1, (1, 9, 1), radius=0.3)], [(5, 5.9, 1), (9, 9, 1)], (PILLAR,))
    with Mission(scene, plan(scene, bound="fast")) as mission:
        mission.advance(0.3)
        mission.strike(DroneLost(0.3, "d0"))
        mission.advance(1.0)
        answer = mission.strike(TaskAdded(1.0, Task("new", (4.1, 5.0, 1.0))))
        assert answer.plan.status == "certified"
        mission.serve_rest()
        outcome = mission.finish()
    assert outcome.flight.measures.served == ("t1",)
    assert set(outcome.unserved) == {"t0", "new"}
    assert all("the smallest drone left needs 0.4 m" in reason for reason in outcome.unserved.values())
    assert flawless(outcome)


def test_tasks_missed_in_a_gust_are_served_later(flying):
    scene, made = flying
    visit = made.flights[longest(made)].visits[0]
    storm = Gust(visit.time - 0.7, 1.0, (0.0, 16.0, 0.0))
    with Mission(scene, made, wind=[storm]) as mission:
        mission.advance(made.cost.makespan)
        assert "away from it" in mission.state.unserved[visit.task]
        missed = set(mission.state.unserved)
        mission.serve_rest()
        outcome = mission.finish()
    assert missed <= set(outcome.flight.measures.served)
    assert outcome.flight.measures.completion == 1.0
    assert outcome.flight.measures.max_tracking_error > 0.1
    assert outcome.unserved == {}


def test_controllers_do_not_know_of_the_wind(flying):
    with Mission(*flying, wind=[Gust(1.0, 1.0, (2.0, 0.0, 0.0))]) as mission:
        blown = mission.finish().flight
    calm = execute(*flying)
    np.testing.assert_array_equal(blown.states[:241], calm.states[:241])
    assert blown.measures.max_tracking_error > 2.0 * calm.measures.max_tracking_error
    assert blown.measures.completion == 1.0
    with pytest.raises(SettingsError, match="has_drag"):
        Mission(*flying, FlightSettings(has_drag=False), wind=[Gust(1.0, 1.0, (2.0, 0.0, 0.0))])


def test_missions_repeat_to_the_last_bit(flying):
    scene, made = flying
    events = [DroneLate(0.0, "d1", 1.0), Gust(0.5, 1.0, (1.0, 1.0, 0.0)), DroneLost(1.3, longest(made))]

    def states():
        with Mission(scene, made) as mission:
            for event in events:
                mission.advance(event.time_s)
                mission.strike(event)
            return mission.finish().flight.states

    np.testing.assert_array_equal(states(), states())


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        (Changes(removed=("t99",)), SettingsError, "removed names 't99'"),
        (Changes(lost=("x",)), SettingsError, "lost names 'x'"),
        (Changes(late={"x": 1.0}), SettingsError, "late names 'x'"),
        (Changes(late={"d0": 1.0, "d1": 1.0, "d2": 1.0}), SettingsError, "only a drone that stands still can be late"),
        (Changes(lost=("d0", "d1", "d2")), SettingsError, "leaves no drone"),
        (Changes(added=(Task("t0", (5.0, 1.0, 1.0)),)), SettingsError, "added names 't0' again"),
        (Changes(added=(Task("new", (5.0, 5.0, 1.0)),)), SceneError, "obstacle 'pillar'"),
    ],
)
def test_changes_that_cannot_be_are_named_and_change_nothing(flying, changes, error, words):
    with Mission(*flying) as mission:
        mission.advance(0.5)
        with pytest.raises(error, match=words):
            mission.replan(changes)
        assert len(mission.state.positions) == 3
        assert mission.state.answers == []
        assert len(mission.state.open) == 5
        assert mission.replan(Changes()).plan.status == "certified"


def test_a_name_is_not_given_twice(flying):
    scene, made = flying
    with Mission(scene, made) as mission:
        mission.advance(made.cost.makespan)
        served = mission.state.served[0]
        mission.state.scene = scene.replace(tasks=tuple(task for task in scene.tasks if task.id != served))
        with pytest.raises(SettingsError, match="again"):
            mission.replan(Changes(added=(Task(served, (5.0, 1.0, 1.0)),)))
