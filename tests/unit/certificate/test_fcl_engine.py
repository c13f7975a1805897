"""The second judge on cases whose answer is known."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from flockopt.certificate import Certificate, Cost, Plan
from flockopt.certificate.case import RESOLUTION_M
from flockopt.certificate.fcl_engine import least_clearance, least_separation
from flockopt.errors import MissingExtra
from flockopt.flights import Curve, Flight
from flockopt.scene import Bounds, Box, Cylinder, Drone, Scene, Sphere
from tests.test_architecture import imports

SPACE = Bounds((-50.0, -50.0, -50.0), (50.0, 50.0, 50.0))


def drone(name, start):
    return Drone(name, start, 1, 0.1, 5.0, 9.0, 90.0)


def plan_of(scene, **curves):
    flights = {name: Flight(curve) for name, curve in curves.items()}
    return Plan(scene.name, scene.sha256, "by hand", "uncertified", {}, {}, flights, Cost(0.0, 0.0, None, None, 0.0))


def straight(start, end, seconds=4.0, at=0.0):
    """From rest to rest."""
    terms = np.zeros((1, 3, 6))
    terms[0, :, 0] = start
    terms[0, :, 3:] = np.subtract(end, start)[:, None] * np.array([10.0, -15.0, 6.0]) / seconds ** np.arange(3, 6)
    return Curve(np.array([at, at + seconds]), terms)


@pytest.mark.parametrize(
    ("obstacle", "margin", "nearest_x"),
    [
        (Sphere("o", (0.0, 2.0, 0.0), 0.5), 2.0 - 0.5 - 0.35, 0.0),
        (Cylinder("o", (1.0, 2.0, 0.0), 0.5, 3.0), 2.0 - 0.5 - 0.35, 1.0),
        (Cylinder("o", (1.0, 2.0, 3.0), 0.5, 2.0), np.hypot(1.5, 2.0) - 0.35, 1.0),
        (Box("o", (-1.0, 2.0, 0.0), (1.0, 1.0, 1.0), np.pi / 4), 2.0 - np.sqrt(0.5) - 0.35, -1.0),
        (Sphere("o", (1.0, 0.2, 0.0), 0.1), 0.2 - 0.1 - 0.35, 1.0),
    ],
)
def test_clearance_of_a_flight_past_an_obstacle(obstacle, margin, nearest_x):
    scene = Scene("s", SPACE, (drone("d0", (-5.0, 0.0, 0.0)),), obstacles=(obstacle,), clearance=0.25)
    found = least_clearance(scene, plan_of(scene, d0=straight((-5, 0, 0), (5, 0, 0))))
    assert found.margin == pytest.approx(margin, abs=2 * RESOLUTION_M)
    assert found.margin <= margin + 1e-12
    assert found.place[0] == pytest.approx(nearest_x, abs=1e-2)
    assert (found.drone, found.other) == (0, 0)


def test_inside_an_obstacle_the_distance_counts_as_zero():
    scene = Scene("s", SPACE, (drone("d0", (-5.0, 0.0, 0.0)),), obstacles=(Sphere("o", (0.0, 0.0, 0.0), 1.0),), clearance=0.2)
    found = least_clearance(scene, plan_of(scene, d0=straight((-5, 0, 0), (5, 0, 0))))
    assert found.margin == pytest.approx(-0.3)
    assert np.linalg.norm(found.place) <= 1.0


def test_the_nearest_of_many_is_found():
    rng = np.random.default_rng(2)
    spheres = tuple(Sphere(f"o{k}", tuple(rng.uniform(-9, 9, 3) + np.array([0, 12, 0])), 0.5) for k in range(40))
    scene = Scene("s", SPACE, (drone("d0", (-5.0, 0.0, 0.0)), drone("d1", (0.0, -2.0, 0.0))), obstacles=spheres)
    curve = straight((-5, 0, 0), (5, 2, 1))
    found = least_clearance(scene, plan_of(scene, d0=curve))
    distances = np.linalg.norm(curve(np.linspace(0, 4, 4001))[:, None] - [o.center for o in spheres], axis=2) - 0.6
    assert found.other == np.unravel_index(distances.argmin(), distances.shape)[1]
    assert found.margin == pytest.approx(distances.min(), abs=1e-5)


def test_separation_in_the_scenes_ellipsoid():
    drones = (drone("d0", (-5.0, 0.0, 0.0)), drone("d1", (5.0, 0.0, 1.0)))
    scene = Scene("s", SPACE, drones, separation=0.5, separation_z=2.0)
    plan = plan_of(scene, d0=straight((-5, 0, 0), (5, 0, 0)), d1=straight((5, 0, 1), (-5, 0, 1)))
    found = least_separation(scene, plan)
    assert found.margin == pytest.approx((1.0 / 2.0 - 1.0) * 0.5, abs=2 * RESOLUTION_M)
    assert found.time == pytest.approx(2.0, abs=1e-2)
    assert (found.drone, found.other) == (0, 1)


def test_parked_and_late_drones_count():
    drones = (drone("d0", (-5.0, 0.0, 0.0)), drone("d1", (0.0, 1.0, 0.0)), drone("d2", (0.0, 9.0, 0.0)))
    scene = Scene("s", SPACE, drones, separation=0.4)
    late = straight((0, 9, 0), (0, 20, 0), at=10.0)
    found = least_separation(scene, plan_of(scene, d0=straight((-5, 0, 0), (5, 0, 0)), d2=late))
    assert found.margin == pytest.approx(0.6, abs=2 * RESOLUTION_M)
    assert (found.drone, found.other) == (0, 1)


def test_a_meeting_between_samples_is_found():
    """Two drones cross at one instant of a minute, where no sampler need look."""
    drones = (drone("d0", (-5.0, 0.0, 0.0)), drone("d1", (0.0, -5.0, 0.0)))
    scene = Scene("s", SPACE, drones, separation=0.4)
    one, other = straight((-5, 0, 0), (5, 0, 0), 60.0), straight((0, -5, 0), (0, 5, 0), 60.0)
    assert least_separation(scene, plan_of(scene, d0=one, d1=other)).margin == pytest.approx(-0.4)


def test_nothing_to_keep():
    scene = Scene("s", SPACE, (drone("d0", (-5.0, 0.0, 0.0)), drone("d1", (0.0, 1.0, 0.0))))
    plan = plan_of(scene, d0=straight((-5, 0, 0), (5, 0, 0)))
    assert least_clearance(scene, plan) is None
    assert least_separation(scene, plan).margin == pytest.approx(1.0 - 2 * scene.drones[0].radius)  # bodies count
    alone = Scene("s", SPACE, scene.drones[:1], separation=1.0)
    assert least_separation(alone, plan_of(alone)) is None


def test_it_shares_no_code_with_the_closed_forms():
    reached, waiting = set(), ["flockopt.certificate.fcl_engine"]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += imports(name) if name != "flockopt" else ()
    closed_forms = {f"flockopt.{name}" for name in ("kernels", "bernstein", "intervals", "continuous", "engines", "judging")}
    assert not reached & closed_forms
    assert "flockopt.certificate.motion_slices" in reached


def test_without_python_fcl_it_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "fcl", None)
    scene = Scene("s", SPACE, (drone("d0", (-5.0, 0.0, 0.0)),))
    with pytest.raises(MissingExtra, match="trajectory"):
        least_clearance(scene, plan_of(scene))


def test_the_judge_loads_fcl_only_when_asked():
    code = "import flockopt.certificate.judge, sys; print('fcl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == ["False"]


def test_the_command_line_asks_it(flockopt, root, tmp_path):
    pytest.importorskip("fcl", reason="python-fcl comes with the extra 'trajectory'")
    scene, plan = root / "examples/scenes/two-drones.json", tmp_path / "plan.json"
    assert flockopt("plan", scene, "-o", plan, "--quiet")[0] == 0
    status, out, _ = flockopt("verify", scene, plan, "--engine", "fcl")
    closed = flockopt("verify", scene, plan)[1]
    assert status == 0
    rows, others = ([line.split()[:3] for line in text.splitlines()] for text in (out, closed))
    assert [row[:2] for row in rows] == [row[:2] for row in others]
    assert isinstance(Plan.load(plan).certificate, Certificate)
    assert flockopt("verify", scene, plan, "--engine", "magic")[0] == 2
