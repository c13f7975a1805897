"""Proposed flights: taken where they hold, never otherwise, whoever proposes them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt import SettingsError, plan, refine_bundles  # noqa: E402 - torch may be missing
from flockopt.flights.smoothing.improve import NOTHING_BETTER, SMOOTHED  # noqa: E402
from flockopt.flights.smoothing.proposals import fly_proposals  # noqa: E402
from flockopt.planning.planners import Planner, Proposal  # noqa: E402
from flockopt.scene.families.layouts import FAMILIES  # noqa: E402
from learned.smoother.batch import MOST_JOINTS  # noqa: E402
from learned.smoother.model import TimedNetwork  # noqa: E402
from learned.smoother.settings import TimedNetworkSettings  # noqa: E402
from learned.smoother.smoother import NetworkProposer, shipped_timed, smooth_flights  # noqa: E402
from tests.flights import check_flights  # noqa: E402
from tests.timed_stages import flown, moving_stages  # noqa: E402


def slower(scene, stages):
    return [[dataclasses.replace(stage, durations=1.5 * stage.durations)] for _, stage in stages]


def nonsense(scene, stages):
    rng = np.random.default_rng(0)
    return [[dataclasses.replace(stage, states=rng.normal(size=stage.states.shape))] for _, stage in stages]


def not_numbers(scene, stages):
    return [[dataclasses.replace(stage, durations=np.nan * stage.durations)] for _, stage in stages]


def nothing(scene, stages):
    return [[] for _ in stages]


@pytest.mark.parametrize("propose", [slower, nonsense, not_numbers, nothing])
def test_bad_proposals_leave_flights_as_they_are(propose):
    scene, flights = flown("forest", drones=3, tasks=5)
    for name, each in fly_proposals(scene, flights, propose).items():
        assert each.flight is flights[name]
        assert each.status == NOTHING_BETTER
        assert each.cost_after == each.cost_before
        assert not each.at_once


@pytest.mark.parametrize("family", FAMILIES)
def test_no_flight_becomes_dearer_slower_or_infeasible(family):
    scene, flights = flown(family, drones=6, tasks=12, seed=11)
    reports = fly_proposals(scene, flights, NetworkProposer(shipped_timed()))
    check_flights(scene, {name: each.flight for name, each in reports.items()})
    for name, each in reports.items():
        assert each.cost_after <= each.cost_before
        assert each.flight.curve.duration <= flights[name].curve.duration
        assert (each.flight is flights[name]) == (each.status != SMOOTHED)
    assert any(each.status == SMOOTHED for each in reports.values())


def test_nan_in_the_network_leaves_flights_as_they_are():
    network = TimedNetwork(TimedNetworkSettings(width=32, blocks=1, heads=2)).eval()
    network.spread.fill_(float("nan"))
    scene, flights = flown("forest", drones=3, tasks=5)
    reports = fly_proposals(scene, flights, NetworkProposer(network))
    assert all(each.flight is flights[name] for name, each in reports.items())


def test_drones_in_another_order_get_the_same_proposals():
    scene, flights = flown("city", drones=4, tasks=9)
    stages, proposer = moving_stages(scene, flights), NetworkProposer(shipped_timed())
    there, back = proposer(scene, stages), proposer(scene, stages[::-1])[::-1]
    for one, other in zip(there, back, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a.states, b.states, atol=2e-2)
            np.testing.assert_allclose(a.durations, b.durations, atol=2e-2)


def test_long_stages_are_not_asked_for():
    scene, flights = flown("forest", drones=1, tasks=2)
    ((drone, stage),) = moving_stages(scene, flights)
    long = dataclasses.replace(stage, durations=np.ones(MOST_JOINTS), states=np.zeros((MOST_JOINTS + 1, 3, 3)), visits=())
    proposals = NetworkProposer(shipped_timed())(scene, [(drone, long), (drone, stage)])
    assert [len(each) for each in proposals] == [0, 3]


def test_missing_weights_are_named(tmp_path):
    with pytest.raises(SettingsError, match="cannot be read"):
        shipped_timed(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize("smoothing", [False, True])
def test_a_plan_with_a_smoother_is_certified_and_sooner(smoothing):
    if smoothing:
        pytest.importorskip("casadi", reason="CasADi comes with the extra 'trajectory'")
    scene, _ = flown("forest", drones=4, tasks=8, seed=3)

    def smoothed(request):
        bundles = refine_bundles(request.scene, travel=request.travel, iterations=100)
        return Proposal(bundles, smoother=smooth_flights)

    def plain(request):
        return dataclasses.replace(smoothed(request), smoother=None)

    given, better = plan(scene, planner=Planner(plain)), plan(scene, planner=Planner(smoothed), smoothing=smoothing)
    assert better.status == "certified"
    assert better.timing["smooth"] > 0.0
    assert sum(f.curve.duration for f in better.flights.values()) < sum(f.curve.duration for f in given.flights.values())
