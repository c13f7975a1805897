"""Other people's trajectories judged: our own export read back, six decimals, files that are no trajectories."""

from __future__ import annotations

import pytest

from flockopt import PlanError, certify, compute_travel, generate, plan
from flockopt.outputs.devices.crazyswarm2 import HEADER, trajectory_csv, trajectory_rows
from flockopt.outputs.devices.trajectories import load_trajectories


@pytest.fixture(scope="module")
def flown():
    scene = generate("forest", drones=4, tasks=9, seed=3)
    scene = scene.replace(
        tasks=tuple(type(task)(task.id, task.position, 1, 0.3 if j % 2 else 0.0) for j, task in enumerate(scene.tasks))
    )
    return scene, plan(scene, planner="classical"), compute_travel(scene)


@pytest.fixture
def exported(flown, tmp_path):
    """A CSV file for each drone of the plan."""
    for drone, flight in flown[1].flights.items():
        (tmp_path / f"{drone}.csv").write_text(trajectory_csv(trajectory_rows(flight.curve)), encoding="utf-8")
    return tmp_path


def rewritten(folder, change):
    for file in folder.glob("*.csv"):
        header, *rows = file.read_text(encoding="utf-8").splitlines()
        numbers = [[float(value) for value in row.split(",")] for row in rows]
        file.write_text(change(header, numbers), encoding="utf-8")


def judged(flown, folder):
    scene, _, travel = flown
    made, rounding = load_trajectories(scene, travel, folder)
    return made, rounding, certify(scene, made, travel=travel, rounding=rounding)


def test_an_export_is_certified_again_with_the_same_visits(flown, exported):
    made, rounding, certificate = judged(flown, exported)
    assert certificate.certified
    assert rounding == 0.0
    assert made.routes == {drone: route for drone, route in flown[1].routes.items() if drone in made.routes}
    assert made.cost.travel == pytest.approx(flown[1].cost.travel)
    for drone, flight in made.flights.items():
        times = [visit.time for visit in flown[1].flights[drone].visits]
        assert [visit.time for visit in flight.visits] == pytest.approx(
            times, abs=0.1
        )  # within a millimetre a while before it rests


def test_six_decimals_are_let_pass_as_far_as_they_explain_the_jumps(flown, exported):
    def six(header, numbers):
        return "\ufeff" + "\n".join(",".join(f"{value:.6f}" for value in row) + "," for row in numbers) + "\n"

    rewritten(exported, six)  # no header, commas at the ends of lines, a byte-order mark, as some tools write
    made, rounding, certificate = judged(flown, exported)
    assert rounding == 5e-7
    assert certificate["continuity"].holds and certificate["start"].holds
    assert not certify(flown[0], made, travel=flown[2])["continuity"].holds


def test_a_jump_that_rounding_does_not_explain_fails(flown, exported):
    def shifted(header, numbers):
        numbers[-1][1] += 0.01
        return "\n".join(",".join(f"{value:.6f}" for value in row) for row in numbers)

    rewritten(exported, shifted)
    assert "continuity" in {clause.name for clause in judged(flown, exported)[2].failed}


def test_tasks_that_nobody_comes_to_are_not_covered(flown, exported):
    served = {drone: route for drone, route in flown[1].routes.items() if route}
    (exported / f"{next(iter(served))}.csv").unlink()
    made, _, certificate = judged(flown, exported)
    assert set(made.unserved) == set(next(iter(served.values())))
    assert not certificate["coverage"].holds


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("d0.csv", "duration\n1.0,2.0\n", r"d0.csv: rows\[0\] is '1.0,2.0'; must be 33 finite numbers"),
        ("d0.csv", ",".join(HEADER), "rows are missing"),
        ("nobody.csv", "1", "nobody.csv is named after no drone"),
    ],
)
def test_what_is_no_trajectory_is_refused(flown, tmp_path, name, text, words):
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(PlanError, match=words):
        load_trajectories(flown[0], flown[2], tmp_path)


def test_an_empty_folder_is_refused(flown, tmp_path):
    with pytest.raises(PlanError, match="holds no CSV file"):
        load_trajectories(flown[0], flown[2], tmp_path)
