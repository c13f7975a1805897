"""Small inputs that went wrong in other people's hands, each with its right answer (tests/cases)."""

from __future__ import annotations

from pathlib import Path

import pytest

from flockopt import Plan, Scene, SceneError, certify, plan

CASES = Path(__file__).parent / "cases"

#: What is flown.
CERTIFIED = (
    "bom", "cross4", "cvrp-P-n16-k8", "default-separation-swap", "door-509", "hetero-door", "one-drone-end-start",
    "sep-below-bodies", "slow", "swap2", "task-at-other-end", "two-utm",
)  # fmt: skip

#: What is refused when it is read, with words of the message.
REFUSED = {
    "dyno-forest4": ("drones[3].end is 0.1511 m from drones[2].end", "at least the separation (0.2 m) apart", "move one"),
    "dyno-maze4": ("drones[3].end is 0.1511 m from drones[2].end", "at least the separation (0.2 m) apart", "move one"),
    "ends-same": ("drones[1].end is 0 m from drones[0].end", "at least the separation (0.5 m) apart", "move one"),
    "heading-deg": ("origin.heading is 90", "radians; did you mean degrees?"),
    "huge-demand2": ("drones[0].capacity is 1000000000000000000", "9007199254740992"),
}

#: What cannot be flown, with words of the reason.
INFEASIBLE = {"task-at-other-start": ("task 't0'", "drone 'd0'", "stands for good", "separation (0.5 m)")}

#: What may be flown or not, but never wrongly: a failed clause says where.
EITHER = ("mapft-tunnel", "maxdist-moveon")


#: Gaps shown where drones return or carry little, at most: the plans are optimal, or nearly so.
GAPS = {"cvrp-P-n16-k8": 0.05, "one-drone-end-start": 1e-6}


def test_every_case_has_its_answer():
    assert sorted(path.stem for path in CASES.glob("*.json")) == sorted([*CERTIFIED, *REFUSED, *INFEASIBLE, *EITHER])


@pytest.mark.parametrize("name", CERTIFIED)
def test_what_can_be_flown_is_certified(name, tmp_path):
    scene = Scene.load(CASES / f"{name}.json")
    made = plan(scene, planner="classical")
    assert made.status == "certified"
    made.save(tmp_path / "plan.json")
    for engine in ("closed-form", "fcl"):
        assert certify(scene, Plan.load(tmp_path / "plan.json"), engine=engine).certified


@pytest.mark.parametrize("name", GAPS)
def test_the_gap_to_what_is_possible_is_small_where_the_plan_is_good(name):
    assert 0.0 <= plan(Scene.load(CASES / f"{name}.json"), planner="classical").cost.gap <= GAPS[name]


@pytest.mark.parametrize("name", REFUSED)
def test_what_nobody_could_fly_is_refused(name):
    with pytest.raises(SceneError) as caught:
        Scene.load(CASES / f"{name}.json")
    assert all(words in str(caught.value) for words in REFUSED[name])


@pytest.mark.parametrize("name", INFEASIBLE)
@pytest.mark.parametrize("planner", ["classical", "exact", "ortools"])
def test_what_is_proven_to_be_impossible_says_why(name, planner):
    made = plan(Scene.load(CASES / f"{name}.json"), planner=planner)
    assert made.status == "infeasible"
    assert made.flights == {}
    assert all(words in made.reason for words in INFEASIBLE[name])


@pytest.mark.parametrize("name", EITHER)
def test_what_is_not_certified_names_the_clause(name):
    made = plan(Scene.load(CASES / f"{name}.json"), planner="classical")
    assert made.status == "certified" or all(clause.drone and clause.detail for clause in made.certificate.failed)
