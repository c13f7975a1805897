"""Replanning from flight: the splice, what has happened, and that nothing uncertified is swapped in."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from flockopt import Cylinder, Scene, SceneError, SettingsError, Task, certify, generate, plan, replan
from flockopt.planning import reallocation
from flockopt.planning import replan as replan_module
from flockopt.planning.replan import Changes
from tests.flights import drone, make_scene


@pytest.fixture(scope="module")
def flying():
    scene = generate("forest", drones=5, tasks=12, seed=4)
    return scene, plan(scene)


def splice_is_smooth(scene, old, answer) -> None:
    for record in answer.scene.drones:
        flight, before = answer.plan.flights.get(record.id), old.flights.get(record.id)
        for order, tolerance in ((0, 1e-6), (1, 1e-6), (2, 1e-5)):
            now = flight.curve(0.0, order) if flight is not None else np.array(record.start if order == 0 else (0, 0, 0))
            then = before.curve(answer.swap_s, order) if before is not None else now
            np.testing.assert_allclose(now, then, atol=tolerance)


def served(answer) -> set:
    return {task for route in answer.plan.routes.values() for task in route}


def open_tasks(scene, old, swap_s: float) -> set:
    begun = {visit.task for flight in old.flights.values() for visit in flight.visits if visit.time <= swap_s}
    return {task.id for task in scene.tasks} - begun


@pytest.mark.parametrize("now_s", [0.0, 0.7, 2.1, 4.0])
def test_a_new_task_is_served_from_a_smooth_splice(flying, now_s: float):
    scene, old = flying
    answer = replan(scene, old, now_s, Changes(added=(Task("new", (10.0, 10.0, 4.5)),)))
    assert answer.plan.status == "certified"
    assert certify(answer.scene, answer.plan).certified
    assert served(answer) == open_tasks(scene, old, answer.swap_s) | {"new"}
    assert not answer.unserved
    splice_is_smooth(scene, old, answer)


def test_a_removed_task_is_not_visited_and_shortens_the_way(flying):
    scene, old = flying
    task = max(old.flights.values(), key=lambda flight: flight.curve.end_time).visits[-1].task
    answer = replan(scene, old, 1.0, Changes(removed=(task,)))
    assert answer.plan.status == "certified"
    assert served(answer) == open_tasks(scene, old, answer.swap_s) - {task}
    splice_is_smooth(scene, old, answer)


def test_a_lost_drones_tasks_go_to_others(flying):
    scene, old = flying
    lost = max(old.flights, key=lambda name: len(old.routes[name]))
    answer = replan(scene, old, 0.5, Changes(lost=(lost,)))
    assert answer.plan.status == "certified"
    assert lost not in answer.plan.routes
    assert served(answer) | set(answer.unserved) == open_tasks(scene, old, answer.swap_s)
    splice_is_smooth(scene, old, answer)


def test_a_lost_drone_serves_nothing_between_its_loss_and_the_swap(flying):
    scene, old = flying
    lost = max(old.flights, key=lambda name: len(old.routes[name]))
    visit = old.flights[lost].visits[0]
    answer = replan(scene, old, visit.time - 0.2, Changes(lost=(lost,)), freeze_s=0.3)
    assert visit.task in served(answer)
    after = replan(scene, old, visit.time + 0.01, Changes(lost=(lost,)), freeze_s=0.3)
    assert visit.task not in served(after)


def test_a_task_that_was_missed_is_served_by_whoever_is_best(flying):
    scene, old = flying
    name = max(old.flights, key=lambda name: len(old.routes[name]))
    visit = old.flights[name].visits[0]
    answer = replan(scene, old, visit.time + 0.1, Changes(missed=(visit.task,)))
    assert answer.plan.status == "certified"
    assert visit.task in served(answer)
    assert certify(answer.scene, answer.plan).certified


def test_a_drone_that_has_used_up_its_capacity_makes_way():
    scene = make_scene([drone(0, (1, 5, 1), 1), drone(1, (9, 9, 1), 2)], [(5, 5, 1), (9, 5, 1)])
    old = plan(scene)
    at_task = next(visit.time for visit in old.flights["d0"].visits)
    answer = replan(scene, old, at_task + 3.0, Changes(added=(Task("new", (5.2, 5, 1)),)))
    assert (answer.strategy, answer.plan.routes["d1"]) == ("old", ("new",))
    assert "d0" in answer.plan.flights
    again = replan(answer.scene, answer.plan, 30.0, Changes())
    assert "d0" not in again.plan.flights
    x, y, z = answer.plan.flights["d0"].curve(99.0)
    near = Changes(added=(Task("near", (x + 0.2, y, z)),))
    drones = tuple(replace(record, capacity=3 if record.id == "d1" else 0) for record in again.scene.drones)
    grown = again.scene.replace(drones=drones)
    parked = replace(again.plan, scene_sha256=grown.sha256)
    assert "near" in replan(grown, parked, 0.0, near).unserved
    assert served(replan(grown, parked, 0.0, near, airborne=("d0",))) == {"near"}


def test_nobody_flies_to_a_task_that_is_no_longer_wanted():
    scene = make_scene([drone(0, (1, 5, 1))], [(3, 5, 1), (5, 9, 3), (7, 5, 1)])
    old = plan(scene)
    answer = replan(scene, old, 0.1, Changes(removed=("t1",)))
    assert served(answer) == {"t0", "t2"}
    curve = answer.plan.flights["d0"].curve
    times = np.linspace(0.0, curve.end_time, 200)
    assert np.linalg.norm(curve(times) - (5, 9, 3), axis=1).min() > 3.0


def test_what_only_a_lost_drone_was_small_enough_for_is_named():
    pillar = Cylinder("pillar", (5, 5, 2), 0.6, 4.0)
    scene = make_scene([drone(0, (1, 1, 1)), drone(1, (1, 9, 1), radius=0.3)], [(5, 5.9, 1), (9, 9, 1)], (pillar,))
    answer = replan(scene, plan(scene), 0.5, Changes(lost=("d0",)))
    assert answer.plan.status == "certified"
    assert served(answer) == {"t1"}
    assert "0.3 m from an obstacle; the smallest drone left needs 0.4 m" in answer.unserved["t0"]


def test_where_no_moment_can_be_swapped_at_the_answer_is_uncertified(flying, monkeypatch):
    def never(*arguments):
        raise SceneError("drones[1].start", "is too near", "must be apart")

    monkeypatch.setattr(replan_module, "hand_over", never)
    answer = replan(*flying, 1.0, Changes())
    assert (answer.plan.status, answer.strategy) == ("uncertified", "none")


def test_new_flights_keep_room_for_tracking_errors():
    scene = make_scene([drone(0, (1, 1, 1))], [(2, 1, 1)], (Cylinder("pillar", (5, 5, 2), 0.6, 4.0),))
    old, added = plan(scene), (Task("new", (9, 9, 1)),)
    kept_m = []
    for margin_m in (0.0, 0.05):
        answer = replan(scene, old, 0.5, Changes(added=added), tracking_margin_m=margin_m)
        assert answer.plan.status == "certified"
        kept_m.append(answer.plan.certificate["clearance"].margin)
    assert kept_m[0] < 0.02
    assert kept_m[1] > 0.05
    with pytest.raises(SettingsError, match="tracking_margin_m is -1"):
        replan(scene, old, 0.5, Changes(), tracking_margin_m=-1.0)


def test_what_no_capacity_is_left_for_is_named():
    scene = make_scene([drone(0, (1, 1, 1), 1), drone(1, (1, 9, 1), 1)], [(9, 1, 1), (9, 9, 1)])
    old = plan(scene)
    answer = replan(scene, old, 1.0, Changes(lost=("d1",)))
    assert answer.plan.status == "certified"
    assert served(answer) == {"t0"}
    assert "the fleet is full" in answer.unserved["t1"]


def test_drones_whose_route_stays_keep_their_curve(flying):
    scene, old = flying
    answer = replan(scene, old, 1.0, Changes())
    assert answer.plan.status == "certified"
    for name, flight in answer.plan.flights.items():
        if answer.plan.routes[name] == tuple(visit.task for visit in flight.visits) and answer.strategy == "old":
            times = np.linspace(0.0, flight.curve.end_time, 50)
            np.testing.assert_allclose(flight.curve(times), old.flights[name].curve(times + answer.swap_s), atol=1e-9)


def test_a_service_in_progress_is_finished_where_it_is():
    scene = make_scene([drone(0, (1, 1, 1))], [Task("t0", (3, 1, 1), service_time=4.0)])
    old = plan(scene)
    (visit,) = old.flights["d0"].visits
    now_s = visit.time + 1.0
    answer = replan(scene, old, now_s, Changes(added=(Task("t1", (8, 1, 1)),)))
    curve = answer.plan.flights["d0"].curve
    left_s = visit.time + 4.0 - answer.swap_s
    np.testing.assert_allclose(curve(np.linspace(0, left_s, 9)), np.tile([3, 1, 1], (9, 1)), atol=1e-9)
    assert served(answer) == {"t1"}


def test_a_drone_that_is_late_waits_no_longer_than_it_is_late():
    scene = make_scene([drone(0, (1, 1, 1), 1), drone(1, (1, 9, 1), 1)], [(9, 1, 1), (9, 9, 1)])
    old = plan(scene)
    answer = replan(scene, old, 0.0, Changes(late={"d0": 2.0}), freeze_s=0.0)
    assert answer.plan.status == "certified"
    assert answer.swap_s == 0.0
    assert answer.plan.flights["d0"].curve.start_time == pytest.approx(2.0)
    assert answer.plan.flights["d1"].curve.start_time == pytest.approx(0.0)
    again = replan(answer.scene, answer.plan, 1.0, Changes(late={"d0": 1.0}), freeze_s=0.3)
    assert again.plan.flights["d0"].curve.start_time == pytest.approx(0.7)  # a second after the event
    with pytest.raises(SettingsError, match="late"):
        replan(scene, old, 1.0, Changes(late={"d0": 2.0}))


def test_replanning_a_replanned_flight(flying):
    scene, old = flying
    first = replan(scene, old, 0.5, Changes(added=(Task("a", (10.0, 10.0, 4.5)),)))
    second = replan(first.scene, first.plan, 1.0, Changes(added=(Task("b", (3.0, 16.0, 4.5)),), removed=("a",)))
    assert second.plan.status == "certified"
    assert "b" in served(second)
    assert "a" not in served(second)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (Changes(removed=("t99",)), "removed names 't99'"),
        (Changes(lost=("x",)), "lost names 'x'"),
        (Changes(lost=("d0", "d1", "d2", "d3", "d4")), "every drone"),
    ],
)
def test_changes_that_name_what_is_not_there(flying, changes: Changes, words: str):
    with pytest.raises(SettingsError, match=words):
        replan(*flying, 1.0, changes)


def test_a_bad_new_task_a_foreign_plan_and_a_bad_time(flying):
    scene, old = flying
    with pytest.raises(SceneError, match=r"added\['new'\]"):
        replan(scene, old, 1.0, Changes(added=(Task("new", (99.0, 0.0, 1.0)),)))
    with pytest.raises(SettingsError, match="now_s is -1"):
        replan(scene, old, -1.0, Changes())
    with pytest.raises(SettingsError, match="plan is for scene"):
        replan(generate("forest", drones=5, tasks=12, seed=5), old, 1.0, Changes())


def test_no_task_is_given_up_for_new_ones():
    tasks = [(4, 5, 1), (9, 9, 3), (8, 1, 3)]
    scene = make_scene([drone(0, (1, 5, 1), 3)], tasks)
    near = tuple(Task(f"near{k}", (2.0 + 0.3 * k, 5.0, 1.0)) for k in range(3))
    answer = replan(scene, plan(scene, planner="classical"), 0.0, Changes(added=near), freeze_s=0.0)
    assert answer.plan.status == "certified"
    assert served(answer) == {"t0", "t1", "t2"}
    assert set(answer.unserved) == {"near0", "near1", "near2"}


def test_tasks_of_a_lost_drone_go_before_new_ones():
    scene = make_scene([drone(0, (1, 5, 1), 2), drone(1, (9, 5, 1), 1)], [(2, 5, 1), (8, 9, 3)])
    old = plan(scene, planner="classical")
    assert old.routes["d1"] == ("t1",)
    answer = replan(scene, old, 0.0, Changes(added=(Task("near", (2.0, 4.0, 1.0)),), lost=("d1",)), freeze_s=0.0)
    assert answer.plan.status == "certified"
    assert served(answer) == {"t0", "t1"}
    assert set(answer.unserved) == {"near"}


@pytest.mark.parametrize(
    ("added", "words"),
    [
        (Task("new", (5.0, 50.0, 1.0)), r"added\['new'\]\.position\[1\] is 50"),
        (Task("t1", (5.0, 5.0, 1.0)), r"added\['t1'\]\.id is 't1'"),
    ],
)
def test_a_bad_new_task_is_named_by_its_id(added, words):
    scene = make_scene([drone(0, (1, 5, 1), 2)], [(2, 5, 1), (8, 9, 3)])
    with pytest.raises(SceneError, match=words):
        replan(scene, plan(scene, planner="classical"), 0.0, Changes(added=(added,)))


def test_where_nothing_has_happened_the_flights_go_on_and_no_bound_is_claimed(flying):
    scene, old = flying
    answer = replan(scene, old, 1.0, Changes())
    assert answer.strategy == "kept"
    assert answer.plan.status == "certified"
    assert answer.plan.cost.lower_bound is None
    assert certify(answer.scene, answer.plan).certified
    assert served(answer) == open_tasks(scene, old, answer.swap_s)
    splice_is_smooth(scene, old, answer)


def test_among_many_obstacles_only_ways_that_matter_are_found_and_verify_agrees(monkeypatch):
    scene = Scene.load("examples/scenes/delft.json")
    old, asked = plan(scene, planner="classical"), []
    compute = reallocation.compute_travel
    for module in (reallocation, replan_module):
        monkeypatch.setattr(module, "compute_travel", lambda *a, **k: asked.append(k) or compute(*a, **k))
    place = scene.tasks[0].position
    answer = replan(scene, old, 2.0, Changes(added=(Task("new", (place[0] + 3.0, place[1] + 2.0, place[2])),)))
    assert answer.plan.status == "certified"
    assert served(answer) == open_tasks(scene, old, answer.swap_s) | {"new"}
    assert asked and all("routes" in keywords or "wanted" in keywords for keywords in asked)
    assert certify(answer.scene, answer.plan).certified
    assert answer.plan.cost.travel == pytest.approx(compute(answer.scene).total(_indices(answer)), rel=1e-6)


def _indices(answer):
    number = {task.id: index for index, task in enumerate(answer.scene.tasks)}
    return [[number[task] for task in answer.plan.routes.get(drone.id, ())] for drone in answer.scene.drones]


def test_replanning_that_is_out_of_time_says_so_and_is_not_swapped_in(flying, monkeypatch):
    scene, old = flying
    slow = reallocation.compute_travel

    def late(*arguments, deadline, **keywords):
        time.sleep(max(deadline.left_s, 0.0) + 0.01)
        return slow(*arguments, deadline=deadline, **keywords)

    monkeypatch.setattr(reallocation, "compute_travel", late)
    answer = replan(scene, old, 1.0, Changes(added=(Task("new", (10.0, 10.0, 4.5)),)), time_limit_s=0.2)
    assert answer.plan.status == "uncertified"
    assert answer.strategy == "none"
    assert answer.plan.reason == "out of time while finding ways among obstacles; give it more time"
