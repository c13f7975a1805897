"""Plans flown in PyBullet: tasks served, room kept, contacts seen, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet comes with the extra 'sim'")

from flockopt import Box, Cylinder, Flight, PlanError, SettingsError, Sphere, Task, plan
from sim import fly
from sim.mission.execute import execute
from sim.mission.measures import measure
from sim.physics import world
from sim.physics.fleet import add_downwash
from sim.physics.settings import FlightSettings
from sim.physics.vehicles import airframes, hover_speeds, vehicles_of
from tests.flights import drone, make_scene

PILLAR = Cylinder("pillar", (5, 5, 2), 0.6, 4.0)


@pytest.fixture(scope="module")
def small():
    scene = make_scene(
        [drone(0, (1, 1, 1)), drone(1, (9, 9, 1))],
        [(9, 2, 2), Task("hold", (5, 8, 2), service_time=1.0), (2, 6, 1.5)],
        (PILLAR,),
    )
    return scene, plan(scene, bound="fast")


@pytest.fixture(scope="module")
def flown(small):
    return execute(*small)


def forged(scene, made, **changes):
    import dataclasses

    return dataclasses.replace(made, scene_sha256=scene.sha256, **changes)


def test_a_certified_plan_is_flown_whole(small, flown):
    measures = flown.measures
    assert sorted(measures.served) == sorted(task.id for task in small[0].tasks)
    assert (measures.completion, flown.touches) == (1.0, ())
    assert measures.mean_tracking_error < 0.01
    assert measures.max_tracking_error < 0.03
    assert measures.min_clearance > small[0].clearance - measures.max_tracking_error
    assert measures.min_separation > small[0].separation - 2 * measures.max_tracking_error
    assert (flown.energy > 0).all()


def test_flights_repeat_to_the_last_bit(small, flown):
    np.testing.assert_array_equal(execute(*small).states, flown.states)


@pytest.mark.parametrize(
    "settings",
    [
        {"vehicle": "cf2x_L250"},
        {"vehicle": "cf21B_500"},
        {"physics_hz": 500},
        {"has_drag": False},
        {"has_downwash": True},
        {"shape": "disc"},
    ],
)
def test_other_ways_to_fly_serve_everything_too(small, settings):
    flight = execute(*small, FlightSettings(**settings))
    assert flight.measures.completion == 1.0
    assert flight.measures.max_tracking_error < 0.03


def test_mellinger_lags_behind(small, flown):
    flight = execute(*small, FlightSettings(controller="mellinger", vehicle="cf2x_L250"))
    assert flight.measures.max_tracking_error > 2 * flown.measures.max_tracking_error


@pytest.mark.parametrize("shape", world.SHAPES)
@pytest.mark.parametrize(
    "obstacle", [PILLAR, Box("wall", (5, 5, 2), (0.4, 3.0, 4.0), 0.5), Sphere("rock", (5, 5, 1), 0.5)], ids=lambda o: o.shape
)
def test_running_into_an_obstacle_is_a_contact(obstacle, shape):
    free = make_scene([drone(0, (2, 5, 1))], [(8, 5, 1)])
    made = plan(free, bound="fast")
    scene = free.replace(obstacles=(obstacle,))
    flight = execute(scene, forged(scene, made), FlightSettings(shape=shape), force=True)
    assert (flight.touches[0].drone, flight.touches[0].other) == ("d0", obstacle.id)
    assert flight.measures.min_clearance < 0.01
    assert np.isfinite(flight.states).all()


def test_drones_that_meet_are_a_contact():
    lone = make_scene([drone(0, (2, 5, 1))], [(8, 5, 1)])
    made = plan(lone, bound="fast")
    scene = make_scene([drone(0, (2, 5, 1)), drone(1, (5, 5, 1), capacity=0)], [(8, 5, 1)])
    flight = execute(scene, forged(scene, made), force=True)
    assert {(touch.drone, touch.other) for touch in flight.touches} & {("d0", "d1"), ("d1", "d0")}
    assert flight.measures.min_separation < 0.25


def test_plans_that_do_not_hold_are_refused(small):
    scene, made = small
    with pytest.raises(PlanError, match=r"scene\.sha256"):
        execute(scene.replace(name="other"), made)
    late = {name: Flight(flight.curve.stretched(0.5), flight.visits) for name, flight in made.flights.items()}
    with pytest.raises(PlanError, match=r"certificate fails.*force=True"):
        execute(scene, forged(scene, made, flights=late))
    nothing = forged(scene, made, flights={}, status="infeasible", reason="no way")
    with pytest.raises(PlanError, match="status is 'infeasible'"):
        execute(scene, nothing)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("controller", "pid"), ("vehicle", "kite"), ("shape", "cube"), ("physics_hz", 0), ("physics_hz", float("nan")),
        ("service_radius", -1), ("settle_s", -0.1), ("attitude_hz", "fast"),
    ],
)  # fmt: skip
def test_bad_settings_are_named(field, value):
    with pytest.raises(SettingsError, match=f"^{field} is {value!r}"):
        FlightSettings(**{field: value})
    with pytest.raises(SettingsError, match="has_downwash"):
        FlightSettings(has_drag=False, has_downwash=True)


def test_controllers_run_at_least_at_the_rate_asked_for():
    assert [FlightSettings(physics_hz=hz).num_inner for hz in (240, 250, 500, 1000)] == [3, 2, 1, 1]


def test_a_task_counts_only_while_its_drone_stays(small):
    scene, made = small
    times = np.arange(0.0, 1.0 + max(flight.curve.end_time for flight in made.flights.values()), 0.01)
    ideal = np.stack(
        [made.flights[d.id].curve(times) if d.id in made.flights else np.tile(d.start, (len(times), 1)) for d in scene.drones],
        axis=1,
    )
    assert measure(scene, made.flights, times, ideal, 0.1).completion == 1.0
    name, visit = next((n, v) for n, flight in made.flights.items() for v in flight.visits if v.task == "hold")
    index = [d.id for d in scene.drones].index(name)
    astray = ideal.copy()
    astray[(times > visit.time + 0.5) & (times < visit.time + 0.6), index, 2] += 0.11
    measures = measure(scene, made.flights, times, astray, 0.1)
    assert list(measures.missed) == ["hold"]
    assert measures.missed["hold"] == pytest.approx(0.11, abs=1e-3)
    assert measures.max_tracking_error == pytest.approx(0.11, abs=1e-9)
    short = times < visit.time + 0.5
    assert "hold" not in measure(scene, made.flights, times[short], ideal[short], 0.1).served


def test_downwash_blows_on_those_below_only():
    scene = make_scene([drone(0, (5, 5, 3)), drone(1, (5, 5, 2)), drone(2, (8, 5, 2))], [])
    vehicles = vehicles_of(scene)
    states, wind = np.zeros((3, 17)), np.zeros((3, 3))
    states[:, :3], states[:, 6], states[:, 13:] = scene.starts, 1.0, hover_speeds(vehicles)
    add_downwash(airframes(vehicles), states, wind)
    assert wind[1, 2] < -1.0
    np.testing.assert_allclose(wind[[0, 2]], 0.0, atol=1e-9)


def test_the_world_can_be_seen(small):
    scene, _ = small
    with world.World(scene, vehicles_of(scene), 1 / 240) as place:
        picture = place.image(80, 60)
    assert picture.shape == (60, 80, 3)
    assert picture.std() > 1.0


def test_fly_command(small, tmp_path, capsys):
    scene, made = small
    scene.save(tmp_path / "scene.json")
    made.save(tmp_path / "plan.json")
    arguments = [str(tmp_path / "scene.json"), str(tmp_path / "plan.json")]
    assert fly.main([*arguments, "--movie", str(tmp_path / "flight.gif")]) == 0
    assert "completion      100.0% (3 of 3 tasks)" in capsys.readouterr().out
    assert (tmp_path / "flight.gif").read_bytes().startswith(b"GIF89a")
    assert fly.main([*arguments, "--events", "3", "--seed", "1"]) == 0
    told = capsys.readouterr().out
    assert told.count("event           ") == 3
    assert "swapped in" in told
    scene.replace(name="other").save(tmp_path / "scene.json")
    assert fly.main(arguments) == 2
    assert "scene.sha256" in capsys.readouterr().err
