"""The compiled drones against drone-models, the compiled Mellinger controller against drone-controllers."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from flockopt import SettingsError
from sim.physics.mellinger import mellinger_wrench, tunings
from sim.physics.quadrotor import drag_force, lead_command, rotor_speed, rotor_thrust, spun, stepped, torque_of, total_thrust
from sim.physics.vectors import axes_of, rotated, turn_between
from sim.physics.vehicles import AIRFRAME, VEHICLES, airframes, vehicles_of
from tests.flights import drone, make_scene
from tests.sim_oracle import CONTROL_HZ, NAMES, NUM_STATES


def frame_of(name):
    return airframes([VEHICLES[name]])


@njit(cache=True)
def thrust_command_of(frames, rpm, target):
    """Records can be passed to compiled code only in their array."""
    return lead_command(frames[0], rpm, target), rotor_thrust(frames[0], rpm), rotor_speed(frames[0], 0.1)


@njit(cache=True)
def physics_of(frames, attitude, velocity, rpm, command, step_s):
    axes = axes_of(attitude)
    drag = drag_force(frames[0], axes, velocity)
    return total_thrust(frames[0], rpm), torque_of(frames[0], rpm), drag, spun(frames[0], rpm, command, step_s)


@njit(cache=True)
def one_step(frames, body, rpm, step_s):
    return stepped(frames[0], body, rpm, (0.0, 0.0, 0.0), True, step_s)


@njit(cache=True)
def wrench_of(own, body, position, velocity, acceleration, step_s):
    return mellinger_wrench(own[0], body, position, velocity, acceleration, step_s)


def random_body(rng):
    attitude = rng.normal(size=4) * [0.3, 0.3, 0.3, 1.0]
    attitude /= np.linalg.norm(attitude)
    return tuple(tuple(part.tolist()) for part in (rng.normal(size=3), attitude, rng.normal(size=3), 2.0 * rng.normal(size=3)))


@pytest.fixture(scope="module")
def oracle(tmp_path_factory):
    """What drone-models and drone-controllers answer: their facts by vehicle and name."""
    if not all(map(find_spec, ("drone_models", "drone_controllers"))):
        pytest.skip("drone-models and drone-controllers come with the dependency group 'dev'")
    path = tmp_path_factory.mktemp("oracle") / "answers.npz"
    script = Path(__file__).resolve().parents[2] / "sim_oracle.py"
    subprocess.run([sys.executable, script, path], env=os.environ | {"SCIPY_ARRAY_API": "1"}, check=True)
    with np.load(path) as answers:
        return dict(answers)


def body_of(row):
    x = row.tolist()
    return tuple(x[:3]), tuple(x[3:7]), tuple(x[7:10]), tuple(x[10:13])


@pytest.mark.parametrize("name", NAMES)
def test_crazyflies_have_the_parameters_of_drone_models(name, oracle):
    ours = VEHICLES[name]
    assert (ours.mass, ours.arm, ours.thrust_to_torque) == tuple(
        oracle[f"{name}/{key}"] for key in ("mass", "L", "thrust2torque")
    )
    np.testing.assert_array_equal(np.diag(ours.inertia), oracle[f"{name}/J"])
    np.testing.assert_array_equal(-np.diag(ours.drag), oracle[f"{name}/drag_matrix"])
    np.testing.assert_array_equal(ours.thrust_curve, oracle[f"{name}/rpm2thrust"])
    np.testing.assert_array_equal(ours.torque_curve, oracle[f"{name}/rpm2torque"])
    np.testing.assert_array_equal([*ours.spin_up, *ours.spin_down], oracle[f"{name}/rotor_dyn_coef"])


@pytest.mark.parametrize("name", NAMES)
def test_dynamics_are_those_of_drone_models(name, oracle):
    frames, step_s = frame_of(name), 1e-6
    gravity = np.array([0.0, 0.0, 9.81 - 9.80665])  # theirs is rounded
    for k in range(NUM_STATES):
        body, rpm = body_of(oracle[f"{name}/states"][k]), tuple(oracle[f"{name}/rpm"][k].tolist())
        after = one_step(frames, body, rpm, step_s)
        faster, turning = (np.array(after[2]) - body[2]) / step_s, (np.array(after[3]) - body[3]) / step_s
        np.testing.assert_allclose(faster, oracle[f"{name}/acceleration"][k] + gravity, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(turning, oracle[f"{name}/angular"][k], rtol=1e-6, atol=1e-4)
        spun_up = physics_of(frames, body[1], body[2], rpm, tuple(oracle[f"{name}/command"][k].tolist()), step_s)[3]
        np.testing.assert_allclose((np.array(spun_up) - rpm) / step_s, oracle[f"{name}/spin"][k], rtol=1e-5, atol=1e-2)


@pytest.mark.parametrize("name", NAMES)
def test_mellinger_asks_for_what_drone_controllers_ask(name, oracle):
    own = tunings(make_scene([drone(0, (1, 1, 1))], []), [name], frame_of(name))
    for k in range(NUM_STATES):
        wanted = oracle[f"{name}/wanted"][k].tolist()
        goals = tuple(wanted[:3]), tuple(wanted[3:6]), tuple(wanted[6:])
        thrust, torque = wrench_of(own, body_of(oracle[f"{name}/flown"][k]), *goals, 1.0 / CONTROL_HZ)
        assert thrust == pytest.approx(oracle[f"{name}/thrust"][k], rel=1e-9)
        np.testing.assert_allclose(torque, oracle[f"{name}/torque"][k], rtol=1e-9, atol=1e-12)


def test_mellinger_flies_crazyflies_only():
    scene = make_scene([drone(0, (1, 1, 1))], [])
    with pytest.raises(SettingsError, match=r"controller is 'mellinger'.*d0 is a quad_2kg"):
        tunings(scene, ["quad_2kg"], frame_of("quad_2kg"))


@pytest.mark.parametrize("name", VEHICLES)
def test_rotors_hover_and_answer_ahead_of_their_lag(name):
    frames, vehicle = frame_of(name), VEHICLES[name]
    rpm = vehicle.hover_rpm
    held = physics_of(frames, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (rpm,) * 4, (rpm,) * 4, 0.01)
    assert held[0] == pytest.approx(vehicle.mass * 9.80665)
    assert held[3] == pytest.approx((rpm,) * 4)
    for target in (0.995 * rpm, 1.005 * rpm):
        command, _, _ = thrust_command_of(frames, rpm, target)
        after = physics_of(frames, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (rpm,) * 4, (command,) * 4, 1e-4)[3][0]
        assert (after - rpm) / 1e-4 == pytest.approx(vehicle.rotor_rate * (target - rpm), rel=1e-2)


def test_turns_are_found_again():
    rng = np.random.default_rng(1)
    for size in (1e-12, 1e-3, 1.0, 3.0):
        before = random_body(rng)[1]
        turn = rng.normal(size=3)
        turn *= size / np.linalg.norm(turn)
        after = rotated(before, tuple(turn.tolist()))
        axes = np.array(axes_of(before)).T
        np.testing.assert_allclose(turn_between(before, after), axes @ turn, atol=1e-12)


def test_scenes_choose_vehicles_by_mass_and_size():
    drones = [drone(0, (1, 1, 1)), drone(1, (3, 1, 1), radius=0.3), drone(2, (5, 1, 1), mass=3.0, max_thrust=60.0)]
    small, big, heavy = vehicles_of(make_scene(drones, []))
    assert (small.mass, big.mass) == (VEHICLES["cf2x_T350"].mass, VEHICLES["quad_2kg"].mass)
    assert (heavy.mass, heavy.most_thrust) == (3.0, 15.0)
    assert heavy.hover_rpm == pytest.approx(VEHICLES["quad_2kg"].hover_rpm)
    with pytest.raises(SettingsError, match=r"vehicle is 'kite'.*cf2x_L250"):
        vehicles_of(make_scene(drones, []), "kite")


def test_airframes_name_every_field_of_a_vehicle():
    record = frame_of("cf2x_L250")[0]
    for field in VEHICLES["cf2x_L250"].__dataclass_fields__:
        np.testing.assert_array_equal(record[field], getattr(VEHICLES["cf2x_L250"], field))
    assert set(AIRFRAME.names) - set(VEHICLES["cf2x_L250"].__dataclass_fields__) == {"least_rpm", "most_rpm"}
