"""The judge, clause by clause, on plans made by hand."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from flockopt import plan
from flockopt.bundles import Bound
from flockopt.certificate import Cost, Plan
from flockopt.certificate import judge as the_judge
from flockopt.certificate.certificate import CLAUSES
from flockopt.certificate.judge import certify
from flockopt.errors import PlanError
from flockopt.flights import Curve, Flight, Visit
from flockopt.scene import Bounds, Drone, Scene, Sphere, Task
from flockopt.travel.travel import straight_travel
from tests.mutation.valid_plans import lane_scene, plan_of_lanes

NO_CLAIM = Cost(length=0.0, travel=0.0, lower_bound=None, gap=None, makespan=0.0)


def make_scene(*drones, tasks=(), obstacles=(), **settings):
    return Scene("hand", Bounds((-10, -10, -10), (10, 10, 10)), drones, tasks, obstacles, **settings)


def make_drone(name, start, **settings):
    given = {"capacity": 2, "radius": 0.1, "max_speed": 2.0, "max_acceleration": 4.0, "max_jerk": 30.0}
    return Drone(name, start, **(given | settings))


def make_plan(scene, flights=None, routes=None, **changes):
    flights, routes = flights or {}, routes or {}
    numbers = {task.id: index for index, task in enumerate(scene.tasks)}
    cost = Cost(
        length=sum(flight.curve.length for flight in flights.values()),
        travel=straight_travel(scene).total([[numbers[t] for t in routes.get(d.id, ())] for d in scene.drones]),
        lower_bound=None,
        gap=None,
        makespan=max((flight.curve.end_time for flight in flights.values()), default=0.0),
    )
    return replace(Plan(scene.name, scene.sha256, "by hand", "certified", routes, {}, flights, cost), **changes)


def rest_to_rest(start, end, span, begin=0.0):
    start, end = np.array(start, dtype=float), np.array(end, dtype=float)
    piece = np.zeros((3, 6))
    piece[:, 0] = start
    piece[:, 3:] = (end - start)[:, None] * np.array([10.0, -15.0, 6.0]) / span ** np.arange(3, 6)
    return Curve([begin, begin + span], piece[None])


def judge(scene, plan, **settings):
    return certify(scene, plan, travel=straight_travel(scene), **settings)


def failed(scene, plan, **settings):
    return [clause.name for clause in judge(scene, plan, **settings).failed]


def test_a_valid_plan_holds_with_every_margin_told():
    rng = np.random.default_rng(0)
    scene = lane_scene(rng)
    plan, travel = plan_of_lanes(scene, rng)
    certificate = certify(scene, plan, travel=travel)
    assert certificate.certified
    assert tuple(clause.name for clause in certificate.clauses) == CLAUSES
    assert all(np.isfinite(clause.margin) and clause.margin >= -1e-6 for clause in certificate.clauses)
    assert certificate["clearance"].obstacle and certificate["clearance"].drone and certificate["clearance"].time is not None
    assert certificate["separation"].other_drone
    assert 0.0 < certificate["limits"].margin < 0.1  # made to fly near its limits


def test_a_scene_without_tasks_keeps_everyone_in_place():
    scene = make_scene(make_drone("a", (0, 0, 0)), make_drone("b", (1, 0, 0)), separation=0.5)
    certificate = judge(scene, make_plan(scene))
    assert certificate.certified
    assert certificate["separation"].margin == pytest.approx(0.5)
    assert certificate["clearance"].margin == np.inf
    assert certificate["bound"].detail == "no bound is claimed"


def test_plans_for_other_scenes_and_unknown_names_are_bad_input():
    scene = make_scene(make_drone("a", (0, 0, 0)), tasks=[Task("t", (1, 0, 0))])
    plan = make_plan(scene)
    other = scene.replace(clearance=0.1)
    with pytest.raises(PlanError) as caught:
        judge(other, plan)
    assert caught.value.field == "scene.sha256"
    assert scene.sha256 in str(caught.value) and other.sha256 in str(caught.value)
    curve = rest_to_rest((0, 0, 0), (1, 0, 0), 2.0)
    for changes, field in (
        ({"routes": {"x": ()}}, "routes[0].drone"),
        ({"routes": {"a": ("t", "x")}}, "routes[0].tasks[1]"),
        ({"unserved": {"x": "why"}}, "unserved[0].task"),
        ({"flights": {"x": Flight(curve)}}, "trajectories[0].drone"),
        ({"flights": {"a": Flight(curve, (Visit("x", 1.0),))}}, "trajectories[0].visits[0].task"),
    ):
        with pytest.raises(PlanError) as caught:
            judge(scene, replace(plan, **changes))
        assert caught.value.field == field


def test_an_unserved_task_fails_coverage_by_name():
    scene = make_scene(make_drone("a", (0, 0, 0)), tasks=[Task("t", (1, 0, 0)), Task("u", (2, 0, 0))])
    clause = judge(scene, make_plan(scene, unserved={"t": "walled in", "u": "walled in"}))["coverage"]
    assert (clause.holds, clause.margin, clause.task) == (False, -2.0, "t")


def test_a_route_beyond_max_distance_fails_capacity():
    scene = make_scene(make_drone("a", (0, 0, 0), max_distance=0.99), tasks=[Task("t", (1, 0, 0))])
    flights = {"a": Flight(rest_to_rest((0, 0, 0), (1, 0, 0), 3.0), (Visit("t", 3.0),))}
    assert failed(scene, make_plan(scene, flights, {"a": ("t",)})) == ["capacity"]
    assert failed(make_scene(make_drone("a", (0, 0, 0), max_distance=1.0), tasks=scene.tasks), make_plan(
        make_scene(make_drone("a", (0, 0, 0), max_distance=1.0), tasks=scene.tasks), flights, {"a": ("t",)}
    )) == []  # fmt: skip


def test_a_drone_that_starts_in_flight_must_fly_at_once():
    drone = make_drone("a", (0, 0, 0), velocity=(1.0, 0, 0))
    scene = make_scene(drone)
    assert failed(scene, make_plan(scene)) == ["start"]
    # x = t - t**3 + t**4 / 2 comes from speed 1 to rest, and from acceleration 0 to 0, in 1 s
    piece = np.zeros((1, 3, 5))
    piece[0, 0] = [0.0, 1.0, 0.0, -1.0, 0.5]
    assert failed(scene, make_plan(scene, {"a": Flight(Curve([0.0, 1.0], piece))})) == []
    assert failed(scene, make_plan(scene, {"a": Flight(Curve([0.5, 1.5], piece))})) == ["start"]
    assert failed(scene, make_plan(scene, {"a": Flight(rest_to_rest((0, 0, 0), (1, 0, 0), 3.0))})) == ["start"]


@pytest.mark.parametrize("end, fine", [((1.0, 0, 0), True), ((1.002, 0, 0), False), ("start", False), (None, True)])
def test_routes_end_where_the_drone_says(end, fine):
    scene = make_scene(make_drone("a", (0, 0, 0), end=end))
    plan = make_plan(scene, {"a": Flight(rest_to_rest((0, 0, 0), (1, 0, 0), 3.0))})
    assert failed(scene, plan) == ([] if fine else ["start"])


def test_a_drone_with_an_end_elsewhere_must_fly_there():
    scene = make_scene(make_drone("a", (0, 0, 0), end=(1.0, 0, 0)))
    assert failed(scene, make_plan(scene)) == ["start"]


@pytest.mark.parametrize("hover, fine", [(2.0, True), (1.9, False)])
def test_service_means_holding_still_all_the_while(hover, fine):
    scene = make_scene(make_drone("a", (0, 0, 0)), tasks=[Task("t", (1, 0, 0), service_time=2.0)])
    go, back = rest_to_rest((0, 0, 0), (1, 0, 0), 2.0), rest_to_rest((1, 0, 0), (0, 0, 0), 2.0)
    still = np.zeros((1, 3, 6))
    still[0, 0, 0] = 1.0
    curve = Curve([0.0, 2.0, 2.0 + hover, 4.0 + hover], np.concatenate([go.coefficients, still, back.coefficients]))
    plan = make_plan(scene, {"a": Flight(curve, (Visit("t", 2.0),))}, {"a": ("t",)})
    # a tenth of a second into a quintic start the drone has moved 1.2 mm
    assert failed(scene, plan) == ([] if fine else ["visits"])


def test_a_second_visit_waits_until_the_first_is_served():
    tasks = [Task("t", (1, 0, 0), service_time=2.0), Task("u", (1, 0, 0))]
    scene = make_scene(make_drone("a", (0, 0, 0)), tasks=tasks)
    curve = rest_to_rest((0, 0, 0), (1, 0, 0), 2.0)
    for time, expected in ((4.0, []), (3.0, ["coverage"])):
        plan = make_plan(scene, {"a": Flight(curve, (Visit("t", 2.0), Visit("u", time)))}, {"a": ("t", "u")})
        assert failed(scene, plan) == expected


def test_parked_drones_are_in_the_way():
    scene = make_scene(make_drone("a", (0, 0, 0)), make_drone("b", (1, 0.3, 0)), separation=0.5)
    clause = judge(scene, make_plan(scene, {"a": Flight(rest_to_rest((0, 0, 0), (2, 0, 0), 3.0))}))["separation"]
    assert (clause.holds, {clause.drone, clause.other_drone}) == (False, {"a", "b"})
    assert clause.margin == pytest.approx(-0.2, abs=1e-6)
    assert clause.time == pytest.approx(1.5, abs=1e-2)


def test_drones_that_wait_at_their_starts_and_ends_are_in_the_way():
    a, b = make_drone("a", (0, 0, 0)), make_drone("b", (4, 0, 0))
    scene = make_scene(a, b, separation=0.5)
    first = Flight(rest_to_rest((0, 0, 0), (2, 0, 0), 3.0))
    for begin in (0.0, 5.0):  # b ends where a is parked by then
        plan = make_plan(scene, {"a": first, "b": Flight(rest_to_rest((4, 0, 0), (2.1, 0, 0), 3.0, begin))})
        assert failed(scene, plan) == ["separation"]


@pytest.mark.parametrize("engine", ["closed-form", "fcl"])
@pytest.mark.parametrize("separation, need", [(0.0, 0.4), (0.1, 0.4), (0.5, 0.5)])
def test_bodies_never_overlap_whatever_the_separation(engine, separation, need):
    """Radii 0.1 and 0.3 pass 0.3 m beside each other: too near by what is more of the separation and both radii."""
    if engine == "fcl":
        pytest.importorskip("fcl", reason="python-fcl comes with the extra 'trajectory'")
    drones = make_drone("a", (0, 0, 0)), make_drone("b", (1, 0.3, 0), radius=0.3)
    scene = make_scene(*drones, separation=separation)
    clause = judge(scene, make_plan(scene, {"a": Flight(rest_to_rest((0, 0, 0), (2, 0, 0), 3.0))}), engine=engine)["separation"]
    assert not clause.holds
    assert clause.margin == pytest.approx(0.3 - need, abs=1e-6)


def test_pairs_are_told_by_what_each_of_them_must_keep():
    """The small drones pass nearer to each other than the large one is to anybody, and are right."""
    drones = make_drone("a", (0, 0, 0)), make_drone("b", (1, 0.25, 0)), make_drone("c", (1, -1.5, 0), radius=1.45)
    scene = make_scene(*drones, separation=0.0)
    clause = judge(scene, make_plan(scene, {"a": Flight(rest_to_rest((0, 0, 0), (2, 0, 0), 3.0))}))["separation"]
    assert {clause.drone, clause.other_drone} == {"a", "c"}
    assert clause.margin == pytest.approx(1.5 - 1.55, abs=1e-6)


def test_what_is_flown_counts_against_max_distance():
    """The route is 1 m of travel, the flight to and fro 3 m."""
    there, back = rest_to_rest((0, 0, 0), (1, 0, 0), 3.0), rest_to_rest((1, 0, 0), (-1, 0, 0), 4.0, 3.0)
    whole = Curve(np.append(there.breakpoints, back.breakpoints[1:]), np.concatenate([there.coefficients, back.coefficients]))
    for limit, expected in ((2.9, ["capacity"]), (3.01, [])):
        scene = make_scene(make_drone("a", (0, 0, 0), max_distance=limit), tasks=[Task("t", (1, 0, 0))])
        plan = make_plan(scene, {"a": Flight(whole, (Visit("t", 3.0),))}, {"a": ("t",)})
        assert failed(scene, plan) == expected
        assert expected == [] or "flies 3 m; its max_distance is 2.9 m" in judge(scene, plan)["capacity"].detail


def test_downwash_widens_the_separation_upwards():
    drones = make_drone("a", (0, 0, 0)), make_drone("b", (0, 0, 1.5))
    flights = {"a": Flight(rest_to_rest((0, 0, 0), (0, 0, 0.8), 3.0))}
    for settings, expected in (({}, []), ({"separation_z": 1.0}, ["separation"])):
        scene = make_scene(*drones, separation=0.5, **settings)
        assert failed(scene, make_plan(scene, flights)) == expected


def test_a_parked_drone_may_stand_exactly_at_its_clearance():
    scene = make_scene(make_drone("a", (0, 0, 0)), obstacles=[Sphere("s", (1.3, 0, 0), 1.0)], clearance=0.2)
    clause = judge(scene, make_plan(scene))["clearance"]
    assert clause.holds and clause.margin == pytest.approx(0.0, abs=1e-9)


def test_bounds_and_gaps_are_claimed_together_and_proven():
    scene = make_scene(make_drone("a", (0, 0, 0)), tasks=[Task("t", (1, 0, 0))])
    flights = {"a": Flight(rest_to_rest((0, 0, 0), (1, 0, 0), 3.0), (Visit("t", 3.0),))}
    plan = make_plan(scene, flights, {"a": ("t",)})
    proof = Bound("rooted-forest", 1.0, np.empty(0))
    proven = replace(plan, cost=replace(plan.cost, lower_bound=1.0, gap=0.0))
    assert failed(scene, plan) == []
    assert failed(scene, proven, bound=proof) == []
    assert failed(scene, proven) == ["bound"]  # nothing proves it
    assert failed(scene, proven, bound=replace(proof, value=0.9)) == ["bound"]
    assert failed(scene, proven, bound=replace(proof, kind="guess")) == ["bound"]
    assert failed(scene, replace(plan, cost=replace(plan.cost, gap=0.0))) == ["bound"]


@pytest.mark.parametrize("scale", [1e7, 1e60, 1e300])
def test_curves_beyond_all_measure_fail_without_a_warning(scale):
    scene = make_scene(make_drone("a", (0, 0, 0)), obstacles=[Sphere("s", (5, 0, 0), 1.0)], separation=0.3)
    curve = Curve([0.0, 1.0, 2.0], np.random.default_rng(0).normal(size=(2, 3, 8)) * scale)
    with np.errstate(over="ignore"):
        plan = make_plan(scene, {"a": Flight(curve)}, cost=NO_CLAIM)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        names = failed(scene, plan)
    assert {"start", "continuity", "limits", "bounds", "clearance", "separation", "bound"} <= set(names)


def test_a_failed_clause_says_where_and_by_how_much():
    scene = make_scene(make_drone("a", (0, 0, 0), max_speed=1.0))
    clause = judge(scene, make_plan(scene, {"a": Flight(rest_to_rest((0, 0, 0), (1, 0, 0), 1.875 / 1.01))}))["limits"]
    assert clause.margin == pytest.approx(-0.01)
    assert clause.where.startswith("drone a, t = 0.9")
    assert clause.detail == "drone a has speed 1.01 m/s; its max_speed is 1"


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_cost_without_a_bound_is_that_of_the_routes_legs_or_of_all_distances(monkeypatch, factor):
    scene = lane_scene(np.random.default_rng(3), lanes=3)
    plan, _ = plan_of_lanes(scene, np.random.default_rng(3))
    plan = replace(plan, cost=replace(plan.cost, lower_bound=None, gap=None))
    compute, asked = the_judge.compute_travel, []

    def fewer(scene, *, routes=None, deadline):
        asked.append(routes is None)
        travel = compute(scene, deadline=deadline)
        return travel if routes is None else replace(travel, start_task=factor * travel.start_task)

    monkeypatch.setattr(the_judge, "compute_travel", fewer)
    assert certify(scene, plan).certified
    assert asked == ([False] if factor == 1.0 else [False, True])
    dearer = replace(plan, cost=replace(plan.cost, travel=1.1 * plan.cost.travel))
    assert not certify(scene, dearer)["bound"].holds


@pytest.fixture(scope="module")
def of_revision_1(root):
    folder = root / "tests" / "golden"
    return Scene.load(folder / "rooms-2x4.json"), Plan.load(folder / "rooms-2x4.revision-1.plan.json")


def test_a_plan_costed_by_the_first_revision_of_travel_still_holds(of_revision_1):
    scene, older = of_revision_1
    certificate = certify(scene, older)
    assert certificate.certified
    (bound,) = (clause for clause in certificate.clauses if clause.name == "bound")
    assert "its travel is of revision 1: compared within 2%" in bound.detail
    assert "travel_revision" not in older.to_dict()["cost"]


@pytest.mark.parametrize(("name", "by"), [("travel", 1.03), ("lower_bound", 1.03), ("gap", 0.03), ("length", 1.0001)])
def test_what_it_claims_beyond_that_fails(of_revision_1, name, by):
    scene, older = of_revision_1
    claimed = getattr(older.cost, name)
    cost = replace(older.cost, **{name: claimed + by if name == "gap" else claimed * by})
    assert [clause.name for clause in certify(scene, replace(older, cost=cost)).failed] == ["bound"]


def test_a_plan_of_this_revision_is_held_to_its_travel(of_revision_1):
    scene, _ = of_revision_1
    made = plan(scene, planner="classical")
    assert made.to_dict()["cost"]["travel_revision"] == Plan.from_dict(made.to_dict()).cost.travel_revision == 2
    off = replace(made, cost=replace(made.cost, travel=1.0001 * made.cost.travel))
    assert [clause.name for clause in certify(scene, off).failed] == ["bound"]
