"""Demonstrations: the same for the same seed, continued where they stopped, and refused where they are damaged."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flockopt import SettingsError
from flockopt.flights.waypoints import leg_clear
from flockopt.geometry.distances import distances
from flockopt.scene.families.layouts import FAMILIES
from learned.demonstrations import writing as demonstrations
from learned.demonstrations.__main__ import main
from learned.demonstrations.array_files import shard_path
from learned.demonstrations.scenes import SceneMix, blocked_routes, draw_scene, random_bundles
from learned.demonstrations.shard_runs import ShardRun
from learned.demonstrations.shards import Demonstrations, load_demonstrations, read_shard, write_shard
from learned.demonstrations.writing import DemonstrationSettings, demonstration_shards, make_shard

SMALL = ["--scenes", "5", "--family", "forest"]


@pytest.fixture(scope="module")
def arrays():
    return make_shard(DemonstrationSettings(SceneMix("forest")), range(4))


@pytest.fixture
def small_shards(monkeypatch):
    monkeypatch.setattr(demonstrations, "SHARD_SCENES", 2)


def files(folder):
    return {path.name: path.read_bytes() for path in folder.glob("shard-*.npz")}


def test_every_scene_is_demonstrated_as_it_is(arrays):
    mix = SceneMix("forest")
    made = Demonstrations(arrays)
    assert len(made) == 4
    assert made.num_samples == 64
    for seed, demonstration in enumerate(made):
        scene, is_hard = draw_scene(mix, seed)
        again = demonstration.scene()
        assert (demonstration.hard, demonstration.seed) == (is_hard, seed)
        np.testing.assert_allclose(again.obstacle_table, scene.obstacle_table, atol=1e-12)
        np.testing.assert_array_equal(again.task_positions, scene.task_positions)
        assert [drone.capacity for drone in again.drones] == [drone.capacity for drone in scene.drones]
        assert (again.bounds, again.clearance, again.separation) == (scene.bounds, scene.clearance, scene.separation)


def test_assignment_bundles_paths_and_samples_agree(arrays):
    for demonstration in Demonstrations(arrays):
        scene, bundles = demonstration.scene(), demonstration.teacher_bundles
        assert (demonstration.teacher_assignment == bundles.assignment(scene.num_tasks)).all()
        assert (demonstration.teacher_assignment.sum(axis=0) == 1).all()
        assert (demonstration.teacher_assignment.sum(axis=1) <= demonstration.capacities).all()
        for drone, route in enumerate(bundles):
            stops, path = demonstration.teacher_stops[drone], demonstration.teacher_paths[drone]
            assert [int(task) for task in stops[stops >= 0]] == list(route)
            np.testing.assert_array_equal(path[stops >= 0], scene.task_positions[list(route)])
            places = demonstration.teacher_place[list(route)]
            np.testing.assert_allclose(
                demonstration.teacher_samples[drone, places], scene.task_positions[list(route)], atol=1e-5
            )
            assert leg_clear(scene, drone, demonstration.teacher_samples[drone].astype(np.float64))
        lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in demonstration.teacher_paths]
        assert demonstration.teacher_cost == pytest.approx(sum(lengths))


def test_paths_keep_the_margin():
    mix = SceneMix("forest", hard_share=1.0, margin=0.1)
    for demonstration in Demonstrations(make_shard(DemonstrationSettings(mix), range(2))):
        need = demonstration.radii[0] + demonstration.clearance + mix.margin
        for path in demonstration.teacher_paths:
            assert distances(demonstration.obstacles, path).min() >= need - 1e-6


@pytest.mark.parametrize("family", FAMILIES)
def test_most_routes_of_hard_scenes_are_blocked(family):
    mix, shares = SceneMix(family, hard_share=1.0, usual_share=1.0), []
    for seed in range(2):
        scene, is_hard = draw_scene(mix, seed)
        assert is_hard
        shares.append(blocked_routes(scene, random_bundles(scene, seed)).mean())
    assert np.mean(shares) > 0.7


def test_scenes_differ_in_size_and_shape():
    scenes = [draw_scene(SceneMix(), seed)[0] for seed in range(40)]
    assert {obstacle.shape for scene in scenes for obstacle in scene.obstacles} == {"box", "cylinder", "sphere"}
    assert {scene.name.split("-")[0] for scene in scenes} == set(FAMILIES)
    usual = [scene for scene in scenes if (scene.num_drones, scene.num_tasks) == (10, 20)]
    assert 0.5 < len(usual) / len(scenes) < 0.9
    assert max(scene.num_drones for scene in scenes) > 12


@pytest.mark.parametrize("teacher", ["teacher", "teacher+refine"])
def test_a_policy_teaches_too(monkeypatch, teacher):
    class Dealer:
        """Deals tasks out in turn, all scenes at once."""

        def bundles(self, scenes, travels):
            assert len(scenes) == len(travels) == 3
            return [SimpleNamespace(routes=tuple(tuple(range(i, s.num_tasks, s.num_drones)) for i in range(s.num_drones)))
                    for s in scenes]  # fmt: skip

    monkeypatch.setattr(demonstrations, "allocator", lambda method: Dealer())
    mix = SceneMix("forest", hard_share=0.0)
    made = Demonstrations(make_shard(DemonstrationSettings(mix, teacher=teacher), range(3)))
    in_turn = [np.arange(len(each.tasks)) % len(each.starts) for each in made]
    dealt = all((each.teacher_drone == drone).all() for each, drone in zip(made, in_turn, strict=True))
    assert dealt == (teacher == "teacher")
    searched = Demonstrations(make_shard(DemonstrationSettings(mix), range(3)))
    costs = [sum(each.teacher_cost for each in those) for those in (made, searched)]
    assert costs[1] < costs[0] * (0.9 if dealt else 1.02)


def test_a_killed_run_goes_on_and_gives_the_same_bytes(tmp_path, small_shards):
    assert main([*SMALL, "--out", str(tmp_path / "clean")]) == 0
    clean = files(tmp_path / "clean")
    assert sorted(clean) == ["shard-00000.npz", "shard-00001.npz", "shard-00002.npz"]
    broken = tmp_path / "broken"
    assert main([*SMALL, "--out", str(broken), "--jobs", "2", "--backend", "threading"]) == 0
    shard_path(broken, 1).unlink()
    kept = shard_path(broken, 0).stat().st_mtime_ns
    assert main([*SMALL, "--out", str(broken)]) == 0
    assert files(broken) == clean
    assert shard_path(broken, 0).stat().st_mtime_ns == kept


def test_more_scenes_are_added_to_those_there_are(tmp_path, small_shards):
    assert main(["--scenes", "3", "--family", "forest", "--out", str(tmp_path)]) == 0
    assert main([*SMALL, "--out", str(tmp_path)]) == 0
    assert [demonstration.seed for demonstration in load_demonstrations(tmp_path)] == [0, 1, 2, 3, 4]


def test_a_dead_worker_is_replaced(tmp_path, small_shards, monkeypatch):
    rounds = []
    make = ShardRun._round

    def once_deadly(run, missing, *rest):
        rounds.append([number for number, _ in missing])
        return make(run, missing[:1], *rest) and len(rounds) > 1 and len(missing) == 1

    monkeypatch.setattr(ShardRun, "_round", once_deadly)
    warnings = []
    demonstration_shards(tmp_path, DemonstrationSettings(SceneMix("forest"))).go(5, warn=warnings.append)
    assert rounds == [[0, 1, 2], [1, 2], [2]]
    assert len(warnings) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--teacher", "owl"], "teacher is 'owl'"),
        (["--paths", "tunnel"], "paths is 'tunnel'"),
        (["--family", "jungle"], "family is 'jungle'"),
        (["--hard", "1.5"], "hard_share is 1.5"),
        (["--usual", "nan"], "usual_share is nan"),
        (["--margin", "0.2"], "margin is 0.2"),
        (["--samples", "1"], "num_samples is 1"),
        (["--scenes", "0"], "scenes is 0"),
        (["--seed", "-1"], "seed is -1"),
        (["--jobs", "0"], "jobs is 0"),
        (["--backend", "pigeons"], "backend is 'pigeons'"),
    ],
)
def test_bad_input_is_named_in_one_line(tmp_path, capsys, arguments, words):
    assert main([*SMALL, *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_another_runs_folder_is_refused(tmp_path, capsys, arrays):
    assert main(["--scenes", "1", "--family", "forest", "--out", str(tmp_path)]) == 0
    assert main(["--scenes", "1", "--family", "city", "--out", str(tmp_path)]) == 2
    assert "holds demonstrations with mix" in capsys.readouterr().err


def spoil(arrays, name, value):
    array = arrays[name].copy()
    array.flat[0] = value
    return {**arrays, name: array}


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("teacher_drone", 99, "names a drone that is not there"),
        ("teacher_place", 64, "a sample that is not there"),
        ("teacher_place", -1, "a sample that is not there"),
        ("tasks", 7.5, "m from a task it serves"),
        ("starts", np.nan, "is not finite at (0, 0)"),
        ("task_offsets", 1, "does not rise from 0"),
    ],
)
def test_damaged_numbers_are_named(tmp_path, arrays, name, value, words):
    write_shard(shard_path(tmp_path, 0), spoil(arrays, name, value))
    with pytest.raises(SettingsError, match=r"shard-00000\.npz") as fault:
        load_demonstrations(tmp_path)
    assert words in str(fault.value)


def test_foreign_and_cut_files_are_named(tmp_path, arrays):
    path = shard_path(tmp_path, 0)
    with pytest.raises(SettingsError, match="has none"):
        load_demonstrations(tmp_path)
    write_shard(path, arrays)
    whole = path.read_bytes()
    for content in (b"", whole[:-100], whole[:2000] + b"x" + whole[2001:]):
        path.write_bytes(content)
        with pytest.raises(SettingsError, match="cannot be read"):
            read_shard(path)
    np.savez(path, seed=np.zeros(3))
    with pytest.raises(SettingsError, match=r"holds \['seed'\] of format None"):
        read_shard(path)
    np.savez(path, seed=np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(SettingsError, match="cannot be read"):
        read_shard(path)
    write_shard(path, {**arrays, "clearance": arrays["clearance"][:, None]})
    with pytest.raises(SettingsError, match="clearance is float64"):
        read_shard(path)


def test_a_flipped_byte_is_named_or_changes_nothing(tmp_path, arrays):
    path = shard_path(tmp_path, 0)
    write_shard(path, arrays)
    whole, rng, num_named = path.read_bytes(), np.random.default_rng(0), 0
    for end in rng.choice([2500, len(whole)], 150):  # the directory of the file is at its end
        place = len(whole) - 1 - int(rng.integers(end))
        path.write_bytes(whole[:place] + bytes([whole[place] ^ int(rng.integers(1, 256))]) + whole[place + 1 :])
        try:
            found = read_shard(path)
        except SettingsError:
            num_named += 1
        else:
            assert all((found[name] == array).all() for name, array in arrays.items())
    assert num_named > 75


def test_shards_of_other_lengths_do_not_mix(tmp_path, arrays):
    write_shard(shard_path(tmp_path, 0), arrays)
    short = DemonstrationSettings(replace(SceneMix("forest"), hard_share=0.0), num_samples=32)
    write_shard(shard_path(tmp_path, 1), make_shard(short, range(1)))
    with pytest.raises(SettingsError, match=r"has \[32, 64\] samples"):
        load_demonstrations(tmp_path)
