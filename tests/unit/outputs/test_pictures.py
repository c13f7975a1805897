"""Pictures and pages: the right kind of file, whole or not at all, with what the plan says in it."""

from __future__ import annotations

import json
import math
import re
import struct
import sys

import numpy as np
import pytest

from flockopt import Curve, Flight, MissingExtra, PlanError, Scene, SettingsError, Visit, generate, show
from flockopt.certificate import Certificate, Clause, Cost, Plan
from flockopt.outputs.pictures.motion import sample_motion
from flockopt.outputs.pictures.style import headline
from flockopt.outputs.pictures.top_view import _best_place


def straight_plan(scene, status="certified", gap=0.0412, flying=None):
    """Drone i flies straight to task i in 4 s, without a care for obstacles."""
    pairs = list(zip(scene.drones, scene.tasks, strict=False))[:flying]
    flights = {}
    for drone, task in pairs:
        start, step = np.array(drone.start), np.array(task.position) - np.array(drone.start)
        coefficients = np.stack([start, 0 * step, 0 * step, step * 10 / 64, -step * 15 / 256, step * 6 / 1024], axis=-1)[None]
        flights[drone.id] = Flight(Curve(np.array([0.0, 4.0]), coefficients), (Visit(task.id, 4.0),))
    return Plan(
        scene_name=scene.name, scene_sha256=scene.sha256, planner="test", status=status,
        routes={drone.id: (task.id,) for drone, task in pairs},
        unserved={task.id: "too far" for task in scene.tasks[len(pairs) :]},
        flights=flights, cost=Cost(12.0, 11.5, None if gap is None else 11.0, gap, 4.0 if pairs else 0.0),
    )  # fmt: skip


def png_size(path):
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert data[-8:-4] == b"IEND"
    return struct.unpack(">II", data[16:24])


def page_data(path):
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="flight">(.*?)</script>', text, re.DOTALL).group(1))


@pytest.mark.parametrize("family", ["forest", "rooms"])
def test_a_picture_of_a_plan_and_of_a_scene(tmp_path, family):
    scene = generate(family, drones=4, tasks=6, seed=1)
    show(scene, tmp_path / "plan.png", straight_plan(scene))
    show(scene, tmp_path / "scene.PNG")
    wide, high = png_size(tmp_path / "plan.png")
    assert 1500 < wide < 2500
    assert 900 < high < 1500
    assert png_size(tmp_path / "scene.PNG")[0] < wide
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plan.png", "scene.PNG"]


@pytest.mark.parametrize("suffix", ["png", "html"])
@pytest.mark.parametrize("size", [(1, 0), (1, 1), (12, 3), (40, 120)])
def test_scenes_of_every_size(tmp_path, suffix, size):
    scene = generate("forest", drones=size[0], tasks=size[1], obstacles=0 if size[0] == 1 else 5)
    path = tmp_path / f"a.{suffix}"
    show(scene, path, straight_plan(scene))
    assert path.stat().st_size > 10_000


def test_the_page_needs_nothing_from_outside(tmp_path):
    scene = generate("city", drones=3, tasks=3)
    show(scene, tmp_path / "a.html", straight_plan(scene))
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|\ssrc=|<link|@import|import\(|fetch\(|XMLHttpRequest|WebSocket", text)
    assert "default-src 'none'" in text
    assert "__" not in re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert len(text) < 300_000


def test_the_page_carries_the_flight(tmp_path):
    scene = generate("city", drones=3, tasks=4)
    plan = straight_plan(scene)
    show(scene, tmp_path / "a.html", plan)
    data = page_data(tmp_path / "a.html")
    assert data["makespan"] == 4.0
    assert [drone["tasks"] for drone in data["drones"]] == [["t0"], ["t1"], ["t2"]]
    assert [task["time"] for task in data["tasks"]] == [4.0, 4.0, 4.0, None]
    assert len(data["obstacles"]) == len(scene.obstacles)
    for drone in scene.drones:
        record = data["drones"][int(drone.id[1:])]
        assert record["breakpoints"] == [0.0, 4.0]
        assert np.allclose(record["coefficients"], plan.flights[drone.id].curve.coefficients, rtol=1e-8)
        end = [sum(term * 4.0**n for n, term in enumerate(axis)) for axis in record["coefficients"][0]]
        assert end == pytest.approx(scene.tasks[int(drone.id[1:])].position, abs=1e-6)


def test_the_page_is_drawn_near_zero(root, tmp_path):
    scene = Scene.load(root / "tests/cases/two-utm.json")
    show(scene, tmp_path / "a.html", straight_plan(scene))
    data = page_data(tmp_path / "a.html")
    places = [data["bounds"]["upper"], *(task["position"] for task in data["tasks"]), data["obstacles"][0]["center"]]
    assert np.abs(np.array(places)).max() <= 5.0
    first = data["drones"][0]
    assert [axis[0] for axis in first["coefficients"][0]] == first["start"] == [-4.0, -4.0, 1.0]


def test_names_cannot_break_out_of_the_page(tmp_path):
    name = "</script><script>alert(1)</script><!-- __VIEW__ $x^2$"
    scene = generate("forest", drones=2, tasks=1).replace(name=name)
    show(scene, tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text
    assert page_data(tmp_path / "a.html")["name"] == name
    show(scene, tmp_path / "a.png")
    png_size(tmp_path / "a.png")


def test_odd_names_are_drawn_in_silence(tmp_path, capfd, recwarn):
    scene = generate("forest", drones=2, tasks=1).replace(name="森 $\\frac{ " + "long " * 60)
    show(scene, tmp_path / "a.png", straight_plan(scene))
    assert capfd.readouterr() == ("", "")
    assert not recwarn.list


@pytest.mark.parametrize("name", ["a.bmp", "a", "a.png.zip", ".png/"])
def test_another_suffix_is_refused(tmp_path, name):
    scene = generate("forest", drones=1, tasks=1)
    with pytest.raises(SettingsError, match=r"\.png or \.html") as caught:
        show(scene, tmp_path / name)
    assert caught.value.field == "path"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["png", "html"])
def test_a_file_that_cannot_be_written(tmp_path, suffix):
    scene = generate("forest", drones=1, tasks=1)
    folder = tmp_path / f"folder.{suffix}"
    folder.mkdir()
    for path in (folder, tmp_path / "nowhere" / f"a.{suffix}"):
        with pytest.raises(SettingsError, match=str(path)):
            show(scene, path)
    assert list(tmp_path.iterdir()) == [folder]


def test_a_plan_for_another_scene_is_refused(tmp_path):
    plan = straight_plan(generate("forest", drones=2, tasks=2, seed=1))
    with pytest.raises(PlanError, match=r"scene\.sha256"):
        show(generate("forest", drones=2, tasks=2, seed=2), tmp_path / "a.png", plan)
    assert not list(tmp_path.iterdir())


def test_without_matplotlib_the_extra_is_named_and_the_page_still_works(tmp_path, monkeypatch):
    scene = generate("forest", drones=2, tasks=2)
    for module in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtra, match=r"flockopt\[show\]"):
        show(scene, tmp_path / "a.png")
    show(scene, tmp_path / "a.html")
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_a_users_own_style_changes_nothing(tmp_path):
    matplotlib = pytest.importorskip("matplotlib", reason="matplotlib comes with the extra 'show'")
    scene = generate("forest", drones=2, tasks=2)
    show(scene, tmp_path / "a.png")
    with matplotlib.rc_context({"font.size": 30, "figure.dpi": 300, "axes.grid": True}):
        show(scene, tmp_path / "b.png")
        assert matplotlib.rcParams["font.size"] == 30
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_least_distances_over_time():
    scene = generate("forest", drones=3, tasks=3, seed=4)
    plan = straight_plan(scene, flying=2)
    motion = sample_motion(scene, plan)
    assert motion.times[0] == 0.0
    assert motion.times[-1] >= 4.0
    assert motion.positions[2] == pytest.approx(np.broadcast_to(scene.starts[2], motion.positions[2].shape))
    for k in (0, 37, -1):
        points = [plan.flights[f"d{i}"].curve(motion.times[k]) for i in range(2)] + [scene.starts[2]]
        nearest = min(math.dist(points[i], points[j]) for i in range(3) for j in range(i))
        assert motion.separation[k] == pytest.approx(nearest)
        gaps = [
            math.hypot(*(p[:2] - np.array(tree.center[:2]))) - tree.radius
            for p in points
            for tree in scene.obstacles
            if tree.height == 5.0
        ]
        if len(gaps) == 3 * len(scene.obstacles):
            assert motion.clearance[k] == pytest.approx(min(gaps) - 0.12)


def test_separation_counts_height_as_the_scene_does():
    scene = generate("forest", drones=2, tasks=0, obstacles=0)
    low = scene.drones[0]
    high = type(low)("d1", (*low.start[:2], low.start[2] + 1.2), 1, 0.12, 2.0, 4.0, 30.0)
    scene = scene.replace(drones=(low, high), separation=0.3, separation_z=0.9)
    stay = Flight(Curve(np.array([0.0, 1.0]), np.array(low.start)[None, :, None]))
    plan = Plan(scene.name, scene.sha256, "test", "certified", {}, {}, {"d0": stay}, Cost(0.0, 0.0, None, None, 1.0))
    motion = sample_motion(scene, plan)
    assert motion.separation == pytest.approx(np.full(len(motion.times), 1.2 / 3))
    assert np.isinf(motion.clearance).all()


def test_headlines_say_what_is_proven_and_no_more():
    scene = generate("forest", drones=1, tasks=1)
    assert headline(scene, None) == ["1 drone", "1 task", "8 obstacles"]
    words = headline(scene, straight_plan(scene))
    assert words == ["certified", "travel 11.5 m", "at most 4.2 % above the optimum", "makespan 4.0 s"]
    assert "proven optimal" in headline(scene, straight_plan(scene, gap=0.0))
    assert "at most 0.11 % above the optimum" in headline(scene, straight_plan(scene, gap=0.001001))
    assert not any("optim" in words for words in headline(scene, straight_plan(scene, gap=None)))


def test_headlines_name_what_failed():
    scene = generate("forest", drones=1, tasks=1)
    plan = straight_plan(scene, status="uncertified")
    bad = [
        Clause("coverage", True, 0.0, "tasks"),
        Clause("clearance", False, -0.1, "m"),
        Clause("limits", False, -1.0, "fraction"),
    ]
    object.__setattr__(plan, "certificate", Certificate(tuple(bad)))
    assert headline(scene, plan)[0] == "uncertified: clearance, limits"
    nothing = Plan(
        scene.name, scene.sha256, "test", "infeasible", {}, {"t0": "walled in"}, {}, Cost(0.0, 0.0, None, None, 0.0),
        reason="t0 is walled in",
    )  # fmt: skip
    assert headline(scene, nothing)[0] == "infeasible: t0 is walled in"


def test_labels_keep_off_what_is_there():
    anchor, half = np.array([100.0, 100.0]), np.array([8.0, 4.0])
    frame, nothing = np.array([[0.0, 0.0], [200.0, 200.0]]), np.empty((0, 2))
    free = _best_place(anchor, half, anchor[None], nothing, np.empty((0, 4)), frame)
    assert free[0] > anchor[0]
    name_there = np.array([[*(free - half), *(free + half)]])
    other = _best_place(anchor, half, anchor[None], nothing, name_there, frame)
    assert (np.abs(other - free) >= 2 * half - 1e-9).any()
    at_edge = _best_place(np.array([198.0, 100.0]), half, nothing, nothing, np.empty((0, 4)), frame)
    assert at_edge[0] + half[0] <= 200.0
