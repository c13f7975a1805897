"""Keys younger than the format: what they mean, and that scenes without them keep their digests."""

from __future__ import annotations

import math

import pytest

from flockopt import Origin, Scene, SceneError
from flockopt.scene.scene import GRAVITY_MPS2

#: Digests of the example scenes from before the keys were there.
DIGESTS = {
    "delft": "ef76bc75c4ededb622137d67c035a1a8ef9b702c75c54f4ac9f315d2f75ceb32",
    "rotterdam": "44a68724653d86948f071f7928108a4c78a62dc74908586656110afdac8f9ed8",
    "two-drones": "584c8f5063fc9718d54e84ab587bbe7cedbd6434cac7403ef323da32c33d382f",
}


@pytest.mark.parametrize("name", DIGESTS)
def test_older_scenes_keep_their_digests(root, name):
    assert Scene.load(root / f"examples/scenes/{name}.json").sha256 == DIGESTS[name]


def test_a_key_that_is_null_is_a_key_that_is_absent(two_drones):
    plain = Scene.from_dict(two_drones)
    two_drones["origin"] = two_drones["drones"][0]["mass"] = two_drones["drones"][1]["max_tilt"] = None
    assert Scene.from_dict(two_drones).sha256 == plain.sha256


def test_given_keys_are_kept_and_counted(two_drones, tmp_path):
    plain = Scene.from_dict(two_drones)
    two_drones["drones"][1] |= {"mass": 0.034, "max_thrust": 0.6, "max_tilt": 0.5}
    two_drones["origin"] = {"latitude": 52.0, "longitude": 4.37, "altitude": 1.5}
    scene = Scene.from_dict(two_drones)
    assert scene.origin == Origin(52.0, 4.37, 1.5, 0.0)
    assert scene.sha256 != plain.sha256
    scene.save(tmp_path / "scene.json")
    assert Scene.load(tmp_path / "scene.json") == scene
    assert "mass" not in scene.to_dict()["drones"][0]


@pytest.mark.parametrize(
    ("changes", "field", "words"),
    [
        ({"mass": 0.0}, "drones[0].mass", "is 0"),
        ({"mass": 1.0, "max_thrust": float("nan")}, "drones[0].max_thrust", "nan"),
        ({"max_thrust": 5.0}, "drones[0].mass", "missing"),
        ({"mass": 1.0, "max_thrust": 9.8}, "drones[0].max_thrust", "hover"),
        ({"max_tilt": 1.6}, "drones[0].max_tilt", "radians"),
        ({"max_tilt": "much"}, "drones[0].max_tilt", "'much'"),
    ],
)
def test_impossible_drones_are_refused(two_drones, changes, field, words):
    two_drones["drones"][0] |= changes
    with pytest.raises(SceneError, match=words) as caught:
        Scene.from_dict(two_drones)
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("origin", "field"),
    [
        ({"latitude": 91, "longitude": 0, "altitude": 0}, "origin.latitude"),
        ({"latitude": 0, "longitude": -181, "altitude": 0}, "origin.longitude"),
        ({"latitude": 0, "longitude": 0}, "origin.altitude"),
        ({"latitude": 0, "longitude": 0, "altitude": 0, "bearing": 0}, "origin.bearing"),
        ({"latitude": 0, "longitude": 0, "altitude": 0, "heading": None}, "origin.heading"),
        ([52, 4, 0], "origin"),
    ],
)
def test_impossible_origins_are_refused(two_drones, origin, field):
    two_drones["origin"] = origin
    with pytest.raises(SceneError) as caught:
        Scene.from_dict(two_drones)
    assert caught.value.field == field


def test_the_flyable_acceleration_is_the_least_of_three(two_drones):
    def flyable(**abilities):
        drone = dict(two_drones["drones"][0], max_acceleration=6.0, **abilities)
        return Scene.from_dict(two_drones | {"drones": [drone]}).drones[0].flyable_acceleration

    assert flyable() == flyable(mass=2.0) == 6.0
    assert flyable(max_tilt=0.3) == pytest.approx(GRAVITY_MPS2 * math.sin(0.3))
    assert flyable(mass=2.0, max_thrust=2.0 * (GRAVITY_MPS2 + 1.5), max_tilt=0.3) == pytest.approx(1.5)
