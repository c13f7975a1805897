"""Ends at which two drones cannot rest are refused, both named."""

from __future__ import annotations

import dataclasses

import pytest

from flockopt import SceneError
from flockopt.scene.apart import least_resting_share


def with_ends(scene, *ends, **changes):
    drones = tuple(dataclasses.replace(drone, end=end) for drone, end in zip(scene.drones, ends, strict=True))
    return scene.replace(drones=drones, **changes)


def test_ends_nearer_than_the_separation_are_refused(scene):
    with pytest.raises(SceneError) as caught:
        with_ends(scene, (8.0, 2.0, 1.0), (8.0, 2.3, 1.0))
    assert caught.value.field == "drones[1].end"
    assert str(caught.value) == (
        "drones[1].end is 0.3 m from drones[0].end; ends must be at least the separation (0.4 m) apart, for both drones rest "
        "there; move one of them"
    )


def test_an_end_at_the_start_counts(scene):
    with pytest.raises(SceneError, match=r"drones\[1\].end is 0.1 m from drones\[0\].end"):
        with_ends(scene, (9.0, 1.1, 1.0), "start")


def test_bodies_count_where_no_separation_is_asked_for(scene):
    with pytest.raises(SceneError, match=r"at least the sum of their radii \(0.2 m\)"):
        with_ends(scene, (8.0, 2.0, 1.0), (8.0, 2.1, 1.0), separation=0.0)


def test_ends_above_each_other_keep_the_vertical_separation(scene):
    assert with_ends(scene, (8.0, 2.0, 1.0), (8.0, 2.0, 1.5))
    with pytest.raises(SceneError, match=r"separation \(0.4 m, 0.8 m upwards\)"):
        with_ends(scene, (8.0, 2.0, 1.0), (8.0, 2.0, 1.5), separation_z=0.8)


def test_ends_just_apart_and_ends_of_one_drone_only_are_accepted(scene):
    assert with_ends(scene, (8.0, 2.0, 1.0), (8.0, 2.4, 1.0))
    assert with_ends(scene, (9.0, 1.0, 1.0), None)


def test_the_least_share_counts_ends_and_grounded_drones(scene):
    assert least_resting_share(scene) == float("inf")
    assert least_resting_share(with_ends(scene, (8.0, 2.0, 1.0), (8.0, 2.6, 1.0))) == pytest.approx(1.5)
    first, second = scene.drones
    grounded = scene.replace(
        drones=(dataclasses.replace(first, end=(9.0, 1.8, 1.0)), dataclasses.replace(second, capacity=0)),
    )
    assert least_resting_share(grounded) == pytest.approx(2.0)
