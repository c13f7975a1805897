"""Plan files: exact round trips, and every kind of malformed file refused with the field named."""

import copy
import json
import math

import numpy as np
import pytest

from flockopt.certificate import Certificate, Plan
from flockopt.certificate.judge import certify
from flockopt.errors import PlanError
from tests.mutation.valid_plans import lane_scene, plan_of_lanes


@pytest.fixture(scope="module")
def plan():
    rng = np.random.default_rng(0)
    scene = lane_scene(rng)
    plan, travel = plan_of_lanes(scene, rng)
    return Plan(**(vars(plan) | {"certificate": certify(scene, plan, travel=travel), "timing": {"total": 0.5}}))


@pytest.fixture(scope="module")
def saved(plan):
    return json.loads(json.dumps(plan.to_dict()))


def test_a_saved_plan_reads_back_exactly(plan, tmp_path):
    plan.save(tmp_path / "plan.json")
    again = Plan.load(tmp_path / "plan.json")
    assert again.to_dict() == plan.to_dict()
    for drone, flight in plan.flights.items():
        assert np.array_equal(again.flights[drone].curve.coefficients, flight.curve.coefficients)
        assert np.array_equal(again.flights[drone].curve.breakpoints, flight.curve.breakpoints)
        assert again.flights[drone].visits == flight.visits
    assert np.array_equal(again.certificate.bound.dual, plan.certificate.bound.dual)
    assert again.certificate.clauses == plan.certificate.clauses


def test_pieces_may_have_fewer_terms_than_others(saved):
    record = copy.deepcopy(saved)
    record["trajectories"][0]["coefficients"][0][1] = [2.5]
    coefficients = Plan.from_dict(record).flights[saved["trajectories"][0]["drone"]].curve.coefficients
    assert coefficients[0, 1].tolist() == [2.5] + [0.0] * 5


def test_an_infeasible_plan_has_a_reason_and_no_trajectories(saved):
    record = copy.deepcopy(saved) | {"status": "infeasible", "reason": "too little capacity", "trajectories": []}
    record |= {"routes": [], "certificate": None}
    plan = Plan.from_dict(record)
    assert (plan.reason, plan.flights, plan.to_dict()["reason"]) == ("too little capacity", {}, "too little capacity")
    with pytest.raises(PlanError, match="infeasible plan has none"):
        Plan.from_dict(record | {"trajectories": saved["trajectories"]})


def change(*path):
    """A function that sets the last of ``path`` at the keys before it; None deletes, ... is for the value None."""
    *keys, last, value = path

    def apply(record):
        for key in keys:
            record = record[key]
        if value is None:
            del record[last]
        else:
            record[last] = None if value is ... else value

    return apply


FIRST = ("trajectories", 0)

MALFORMED = [
    (change("format", "flockopt.plan/2"), "format"),
    (change("format", None), "format"),
    (change("extra", 1), "extra"),
    (change("scene", "name", ""), "scene.name"),
    (change("scene", "sha256", "abc"), "scene.sha256"),
    (change("scene", "size", 1), "scene.size"),
    (change("planner", 3), "planner"),
    (change("status", "splendid"), "status"),
    (change("reason", ""), "reason"),
    (change("routes", {}), "routes"),
    (change("routes", 1, "drone", "d0"), "routes[1].drone"),
    (change("routes", 1, "tasks", "t1.0"), "routes[1].tasks"),
    (change("routes", 0, "tasks", 1, 7), "routes[0].tasks[1]"),
    (change("unserved", [{"task": "t0.0", "reason": ""}]), "unserved[0].reason"),
    (change("unserved", [{"task": "x", "reason": "y"}] * 2), "unserved[1].task"),
    (change(*FIRST, "drone", "d1"), "trajectories[1].drone"),
    (change(*FIRST, "visits", None), "trajectories[0].visits"),
    (change(*FIRST, "visits", 0, "time", -1.0), "trajectories[0].visits[0].time"),
    (change(*FIRST, "visits", 0, "task", 1), "trajectories[0].visits[0].task"),
    (change(*FIRST, "breakpoints", [0.0]), "trajectories[0].breakpoints"),
    (change(*FIRST, "breakpoints", 1, 0.0), "trajectories[0].breakpoints[1]"),
    (change(*FIRST, "breakpoints", 0, -1.0), "trajectories[0].breakpoints[0]"),
    (change(*FIRST, "breakpoints", 1, True), "trajectories[0].breakpoints[1]"),
    (change(*FIRST, "coefficients", []), "trajectories[0].coefficients"),
    (change(*FIRST, "coefficients", 0, [[0.0], [0.0]]), "trajectories[0].coefficients[0]"),
    (change(*FIRST, "coefficients", 0, 1, [0.0] * 9), "trajectories[0].coefficients[0][1]"),
    (change(*FIRST, "coefficients", 0, 1, []), "trajectories[0].coefficients[0][1]"),
    (change(*FIRST, "coefficients", 0, 2, 1, math.nan), "trajectories[0].coefficients[0][2][1]"),
    (change(*FIRST, "coefficients", 0, 2, 1, math.inf), "trajectories[0].coefficients[0][2][1]"),
    (change(*FIRST, "coefficients", 0, 2, 1, "1"), "trajectories[0].coefficients[0][2][1]"),
    (change("cost", "travel", -1.0), "cost.travel"),
    (change("cost", "makespan", ...), "cost.makespan"),
    (change("cost", "gap", "small"), "cost.gap"),
    (change("cost", "gap", None), "cost.gap"),
    (change("timing", "total", math.nan), "timing.total"),
    (change("timing", []), "timing"),
    (change("certificate", "clauses", []), "certificate.clauses"),
    (change("certificate", "clauses", 0, "name", "beauty"), "certificate.clauses[0].name"),
    (change("certificate", "clauses", 0, "holds", 1), "certificate.clauses[0].holds"),
    (change("certificate", "clauses", 2, "place", [1.0]), "certificate.clauses[2].place"),
    (change("certificate", "bound", "dual", 0, math.nan), "certificate.bound.dual[0]"),
    (change("certificate", "bound", "dual", ...), "certificate.bound.dual"),
    (change("certificate", "bound", "kind", None), "certificate.bound.kind"),
]


@pytest.mark.parametrize("breaking, field", MALFORMED, ids=[f"{n}-{field}" for n, (_, field) in enumerate(MALFORMED)])
def test_malformed_plans_are_refused_by_field(saved, breaking, field):
    record = copy.deepcopy(saved)
    breaking(record)
    with pytest.raises(PlanError) as caught:
        Plan.from_dict(record)
    assert caught.value.field == field


def test_a_plan_that_is_no_object_is_refused():
    with pytest.raises(PlanError, match="must be an object"):
        Plan.from_dict([])


def test_nothing_is_written_where_writing_fails(plan, tmp_path):
    with pytest.raises(PlanError):
        plan.save(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_certificates_without_a_bound_round_trip(plan):
    certificate = Certificate(plan.certificate.clauses)
    assert Certificate.from_dict(json.loads(json.dumps(certificate.to_dict()))) == certificate
