"""What drone-models and drone-controllers say of random states, written to an .npz file.

They must be imported before scipy and with SCIPY_ARRAY_API=1, so the tests run this file in a process of its own:

    SCIPY_ARRAY_API=1 python tests/sim_oracle.py FILE.npz
"""

from __future__ import annotations

import sys
from functools import partial

import numpy as np

NAMES = ("cf2x_L250", "cf2x_P250", "cf2x_T350", "cf21B_500")
NUM_STATES = 40
CONTROL_HZ = 500
PARAMETERS = ("mass", "J", "L", "drag_matrix", "rpm2thrust", "rpm2torque", "rotor_dyn_coef", "thrust2torque")


def random_states(rng):
    """Position, attitude, velocity and body rates, attitudes leaning up to about 70 degrees."""
    attitudes = rng.normal(size=(NUM_STATES, 4)) * [0.3, 0.3, 0.3, 1.0]
    attitudes /= np.linalg.norm(attitudes, axis=1)[:, None]
    return rng.normal(size=(NUM_STATES, 3)), attitudes, rng.normal(size=(NUM_STATES, 3)), 2.0 * rng.normal(size=(NUM_STATES, 3))


def dynamics_of(name, rng):
    from drone_models import parametrize
    from drone_models.first_principles import dynamics

    model = partial(parametrize(dynamics, name), prop_inertia=0.0)  # our rotors have no momentum of their own
    states = random_states(rng)
    rpm, command = rng.uniform(12000.0, 22000.0, (2, NUM_STATES, 4))
    rates = [model(*state, one, speed) for *state, one, speed in zip(*states, command, rpm, strict=True)]
    return {"states": np.hstack(states), "rpm": rpm, "command": command} | {
        "acceleration": np.array([rate[2] for rate in rates]),
        "angular": np.array([rate[3] for rate in rates]),
        "spin": np.array([rate[4] for rate in rates]),
    }


def mellinger_of(name, rng):
    """Thrust and torque on a row of states, the integrals carried from one to the next."""
    from drone_controllers import parametrize
    from drone_controllers.mellinger import attitude2force_torque, state2attitude

    position_law, attitude_law = parametrize(state2attitude, name), parametrize(attitude2force_torque, name)
    states = random_states(rng)
    wanted = np.hstack([states[0] + 0.2 * rng.normal(size=(NUM_STATES, 3)), rng.normal(size=(NUM_STATES, 6))])
    integral, yaw, last = None, None, np.zeros(3)
    thrusts, torques = [], []
    for *state, goal in zip(*states, wanted, strict=True):
        asked, grown = position_law(*state, np.concatenate([goal, np.zeros(4)]), integral, ctrl_freq=CONTROL_HZ)
        thrust, torque, turned = attitude_law(*state, asked, last, yaw, ctrl_freq=CONTROL_HZ)
        integral, yaw, last = (grown,), (turned,), state[3]
        thrusts.append(float(np.ravel(thrust)[0]))
        torques.append(torque)
    return {"flown": np.hstack(states), "wanted": wanted, "thrust": np.array(thrusts), "torque": np.array(torques)}


def main(path):
    from drone_models.core import load_params

    answers = {}
    for seed, name in enumerate(NAMES):
        rng = np.random.default_rng(seed)
        parameters = load_params("first_principles", name)
        facts = {key: parameters[key] for key in PARAMETERS} | dynamics_of(name, rng) | mellinger_of(name, rng)
        answers |= {f"{name}/{key}": value for key, value in facts.items()}
    np.savez(path, **answers)


if __name__ == "__main__":
    main(sys.argv[1])
