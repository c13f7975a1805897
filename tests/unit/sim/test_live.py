"""The playground without anybody at it: orders, the page, and how it is closed."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet comes with the extra 'sim'")
pytest.importorskip("viser", reason="viser comes with the extra 'live'")

import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from flockopt import Box, Cylinder, SceneError, SettingsError, SolverFailed, generate, plan
from sim.live import __main__ as live
from sim.live import page as page_module
from sim.live.page import Page
from sim.live.picking import first_hit, typed_point
from sim.live.serving import HOST, local_server
from sim.live.session import MOST_SPEED, Session
from sim.live.text import log_text, status_text, verdict_text
from tests.flights import drone, make_scene


@pytest.fixture(scope="module")
def planned():
    scene = generate("forest", drones=3, tasks=6, seed=0)
    return scene, plan(scene, bound="fast", tracking_margin_m=0.03)


@pytest.fixture
def session(planned):
    with Session(*planned, tracking_margin_m=0.03) as session:
        yield session


def fly(session, seconds):
    for _ in range(round(seconds / 0.1)):
        session.tick(0.1)


def fly_out(session):
    for _ in range(1000):
        if session.is_waiting:
            return session.view()
        session.tick(0.1)
    raise AssertionError("the flight does not end")


def states(view):
    return {task.id: task.state for task in view.tasks}


def free_place(scene):
    """Somewhere a drone may hover."""
    for x in np.linspace(1, 9, 20):
        try:
            scene.replace(tasks=(*scene.tasks, type(scene.tasks[0])("probe", (float(x), 9.0, 3.0))))
        except SceneError:
            continue
        return float(x), 9.0, 3.0
    raise AssertionError("the scene is full")


def test_a_flight_left_alone_serves_everything(session, planned):
    view = fly_out(session)
    assert set(states(view).values()) == {"served"}
    assert (view.state, view.contacts, view.lost) == ("waiting", 0, {})
    assert view.now_s >= planned[1].cost.makespan
    session.tick(10.0)
    assert session.view().now_s == view.now_s


def test_a_task_added_in_flight_is_served(session, planned):
    fly(session, 1.0)
    name = session.add_task(free_place(planned[0]))
    view = session.view()
    assert (states(view)[name], view.answer.plan.status) == ("open", "certified")
    assert 0.0 < view.swap_s < 0.31
    assert next(task.drone for task in view.tasks if task.id == name) in view.drones
    assert states(fly_out(session))[name] == "served"


def test_a_waiting_fleet_takes_orders(session, planned):
    fly_out(session)
    name = session.add_task(free_place(planned[0]))
    assert not session.is_waiting
    assert states(fly_out(session))[name] == "served"


def test_tasks_of_a_drone_that_is_lost_go_to_others(session, planned):
    fly(session, 0.5)
    ahead = {name: set(tasks) for name, tasks in planned[1].routes.items()}
    lost = max(ahead, key=lambda name: len(ahead[name]))
    session.kill(lost)
    view = session.view()
    assert lost not in view.drones
    assert set(view.lost) == {lost}
    assert lost not in session.ways()
    assert all(task.drone != lost for task in view.tasks)
    view = fly_out(session)
    assert set(states(view).values()) <= {"served", "left out"}
    assert {task for task in ahead[lost] if states(view)[task] == "served"}
    assert all(task.reason for task in view.tasks if task.state == "left out")
    np.testing.assert_array_equal(session.view().lost[lost], view.lost[lost])


def test_a_task_withdrawn_is_not_served(session, planned):
    last = max((visit for flight in planned[1].flights.values() for visit in flight.visits), key=lambda visit: visit.time)
    fly(session, 0.5)
    session.remove_task(last.task)
    assert last.task not in states(session.view())
    assert last.task not in states(fly_out(session))
    with pytest.raises(SettingsError, match="task is"):
        session.remove_task(last.task)


def test_names_of_added_tasks_never_come_again(session, planned):
    place = free_place(planned[0])
    first = session.add_task(place)
    session.remove_task(first)
    assert session.add_task(place) != first


def test_a_gust_moves_drones_and_wakes_a_waiting_fleet(session):
    before = fly_out(session).drones
    session.blow((3.0, 0.0, 0.0))
    fly(session, 1.0)
    moved = [session.view().drones[name] - place for name, place in before.items()]
    assert all(shift[0] > 0.005 for shift in moved)
    after = fly_out(session)
    assert all(np.linalg.norm(after.drones[name] - place) < 0.03 for name, place in before.items())


def test_bad_orders_are_refused_and_change_nothing(session):
    fly(session, 0.5)
    before = states(session.view())
    with pytest.raises(SceneError, match=r"^the task.position\[0\] is -1"):
        session.add_task((-1.0, 1.0, 1.0))
    with pytest.raises(SettingsError, match="lost names 'd99'"):
        session.kill("d99")
    for name in list(session.view().drones)[1:]:
        session.kill(name)
    with pytest.raises(SettingsError, match="lost leaves no drone"):
        session.kill(next(iter(session.view().drones)))
    with pytest.raises(SettingsError, match="speed is 0"):
        session.speed = 0.0
    with pytest.raises(SettingsError, match="speed is 100000; must be at most 8"):
        session.speed = 1e5
    with pytest.raises(SettingsError, match="seconds is 0"):
        session.blow((1.0, 0.0, 0.0), seconds=0.0)
    assert states(session.view()).keys() == before.keys()


def test_the_clock_follows_pause_and_speed(session):
    session.speed = 3.0
    fly(session, 0.2)
    assert session.view().now_s == pytest.approx(0.6, abs=0.01)
    session.is_paused = True
    fly(session, 1.0)
    assert session.view().state == "paused"
    assert session.view().now_s == pytest.approx(0.6, abs=0.01)
    session.is_paused = False
    session.tick(60.0)
    assert session.view().now_s < 1.0, "a long pause of the machine must not be flown in one go"


def test_words_say_what_is_flown_and_what_the_judge_says(session, planned):
    fly(session, 0.5)
    session.kill("d0")
    view = session.view()
    assert "2 in the air, 1 lost" in status_text(view)
    assert "**certified**, to spare: clearance" in verdict_text(view)
    assert re.search(r"last answer: \d+ ms, \w+ bundles, \*\*certified\*\*", verdict_text(view))
    assert "d0 is lost; answered in" in log_text(view).splitlines()[0]


def test_rays_hit_what_is_in_front():
    scene = make_scene([drone(0, (1, 1, 1))], [], (Cylinder("pillar", (5, 5, 2), 0.6, 4.0), Box("box", (8, 8, 1), (1, 1, 2))))
    assert first_hit(scene, (2, 2, 8), (0, 0, -5)) == (2, 2, 0)
    assert first_hit(scene, (8, 8, 8), (0, 0, -1)) == pytest.approx((8, 8, 2), abs=2e-3)
    assert first_hit(scene, (0, 5, 1), (1, 0, 0)) == pytest.approx((4.4, 5, 1), abs=2e-3)
    for origin, direction in (((2, 2, 8), (0, 0, 1)), ((2, 2, 8), (1, 0, 0)), ((20, 20, 8), (0, 0, -1))):
        with pytest.raises(SettingsError, match="click leads out of the scene"):
            first_hit(scene, origin, direction)


def test_typed_points():
    assert typed_point("1.5, 2, 0.8") == typed_point(" 1.5 2 .8 ") == (1.5, 2.0, 0.8)
    for words in ("", "1, 2", "1, 2, up", "1 2 3 4"):
        with pytest.raises(SettingsError, match="place is"):
            typed_point(words)


@pytest.fixture
def page(session):
    page = Page(session, 0)
    yield page
    page.close()


def test_the_page_answers_on_this_machine_only(page):
    with urllib.request.urlopen(page.url, timeout=10) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    port = page.server.get_port()
    for other in ("127.0.0.2", *{info[4][0] for info in _addresses()} - {HOST}):
        with socket.socket() as stranger, pytest.raises(OSError, match=r"."):
            stranger.settimeout(2.0)
            stranger.connect((other, port))


def _addresses():
    try:
        return socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
    except OSError:
        return []


def connected(page, origin):
    """What a websocket of the page is told first, from a page of ``origin``."""
    port = page.server.get_port()
    with connect(
        f"ws://{HOST}:{port}", origin=origin and origin.format(port=port), subprotocols=[f"viser-v{viser.__version__}"]
    ) as socket:
        return socket.recv(timeout=10)


@pytest.mark.parametrize("origin", ["http://127.0.0.1:{port}", "http://localhost:{port}", None])
def test_the_page_itself_is_served(page, origin):
    page.refresh()
    assert connected(page, origin)


@pytest.mark.parametrize(
    "origin",
    [
        "https://evil.example",
        "http://evil.example:{port}",
        "http://127.0.0.1:1",
        "http://127.0.0.1:{port}.evil.example",
        "null",
    ],
)
def test_other_pages_are_refused(page, origin):
    with pytest.raises(InvalidStatus, match="403"):
        connected(page, origin)


def test_a_viser_that_cannot_be_guarded_is_not_used(monkeypatch):
    stopped = []
    server = SimpleNamespace(stop=lambda: stopped.append(True))
    monkeypatch.setattr(viser, "ViserServer", lambda **settings: server)
    with pytest.raises(SolverFailed, match="whom to listen to"):
        local_server(0, "test")
    assert stopped == [True]


def test_sliders_stay_within_their_ends_whatever_is_sent(page, session):
    slider = next(handle for handle in page.server.gui._gui_input_handle_from_uuid.values() if handle.label == "Speed")
    for sent, taken in ((1e5, MOST_SPEED), (-1.0, 0.1), (2.0, 2.0)):
        slider.value = sent
        assert (session.speed, slider.value) == (taken, taken)
    slider.value = float("nan")
    assert session.speed == 2.0


def test_the_page_shows_the_session(page, session, planned):
    page.refresh()
    fly(session, 1.0)
    name = session.add_task(free_place(planned[0]))
    session.kill("d1")
    page.refresh()
    scene = page.server.scene
    assert scene.get_handle_by_name(f"/tasks/{name}") is not None
    assert scene.get_handle_by_name("/ways") is not None
    assert scene.get_handle_by_name("/drones/1").wireframe
    np.testing.assert_allclose(scene.get_handle_by_name("/drones/0").position, session.view().drones["d0"])
    assert name in page._open_tasks.options
    fly_out(session)
    page.refresh()
    assert scene.get_handle_by_name("/ways") is None
    assert "waiting" in page._status.content


def test_what_is_refused_is_told_to_whoever_asked():
    told = []
    event = SimpleNamespace(client=SimpleNamespace(add_notification=lambda *words, **looks: told.append(words)))

    def order(event):
        raise SettingsError("place", "is 'x'", "must be three numbers")

    page_module._order(order)(event)
    assert told == [("Refused", "place is 'x'; must be three numbers")]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["missing.json"], "missing.json cannot be read"), (["scene.json", "--port", "70000"], "port is 70000"),
        (["scene.json", "--speed", "0"], "speed is 0"), (["scene.json", "--speed", "9"], "speed is 9; must be at most 8"),
        (["scene.json", "--spare", "-1"], "spare is -1"),
        (["scene.json", "--planner", "oracle"], "planner is 'oracle'"),
    ],
)  # fmt: skip
def test_bad_input_is_named(options, words, tmp_path, monkeypatch, capsys):
    make_scene([drone(0, (1, 1, 1))], [(2, 2, 2)]).save(tmp_path / "scene.json")
    monkeypatch.chdir(tmp_path)
    assert live.main(options) == 2
    assert words in capsys.readouterr().err


def test_a_missing_viser_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert live.main(["scene.json"]) == 2
    assert "viser is not installed; it comes with the extra 'live'" in capsys.readouterr().err


def test_help_teaches(capsys):
    with pytest.raises(SystemExit):
        live.main(["--help"])
    text = capsys.readouterr().out
    for word in ("click a place", "gust", "Ctrl-C", "examples:", "--spare", "127.0.0.1"):
        assert word in text


def test_scenes_that_cannot_be_certified_are_refused(tmp_path, capsys):
    make_scene([drone(0, (1, 1, 1), capacity=0)], [(2, 2, 2)]).save(tmp_path / "scene.json")
    assert live.main([str(tmp_path / "scene.json")]) == 2
    assert "plan is infeasible" in capsys.readouterr().err


def test_the_command_serves_until_ctrl_c(tmp_path, root):
    make_scene([drone(0, (1, 1, 1))], [(2, 2, 2)]).save(tmp_path / "scene.json")
    command = [sys.executable, "-m", "sim.live", "scene.json", "--port", "0"]
    environment = os.environ | {"PYTHONPATH": str(root)}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout.readline() == "planning test: 1 drones, 1 tasks\n"
        url = running.stdout.readline().split()[0]
        assert urllib.request.urlopen(url, timeout=10).status == 200
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=30)
    assert (running.returncode, err) == (0, "")
    assert "ended after" in out
