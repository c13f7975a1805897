"""The student's network: shapes, masks, permutations, geometry, and one output of a seeded tiny network."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt import SettingsError, Sphere  # noqa: E402 - torch may be missing
from flockopt.geometry.distances import distances, surface_normals  # noqa: E402
from learned.networks.obstacle_distance import outward, signed_distance  # noqa: E402
from learned.student.checkpoint import load_student, save_student  # noqa: E402
from learned.student.network.leg_frame import leg_frames, to_points, to_residuals  # noqa: E402
from learned.student.scenes.batch import collate  # noqa: E402
from learned.student.scenes.examples import example  # noqa: E402
from learned.student.settings import CONFIGS, StudentSettings  # noqa: E402
from tests.student_scenes import random_routes, taught_example, tiny_student  # noqa: E402

CONFIG_NAMES = tuple(CONFIGS)


def denoised(student, batch, noise, level=500):
    _, conditions = student.condition(batch)
    with torch.inference_mode():
        return student.denoiser(noise, torch.full((len(noise),), level), conditions)


def noise_for(batch, seed=1):
    return torch.randn(batch.ways.straight.shape, generator=torch.Generator().manual_seed(seed))


def relabelled(scene, drones, tasks, obstacles):
    return dataclasses.replace(
        scene,
        drones=tuple(scene.drones[i] for i in drones),
        tasks=tuple(scene.tasks[j] for j in tasks),
        obstacles=tuple(scene.obstacles[k] for k in obstacles),
    )


@pytest.mark.parametrize("config", CONFIG_NAMES)
def test_shapes(config):
    student = tiny_student(config)
    batch = collate([taught_example("city", drones=3, tasks=5), taught_example("forest", drones=4, tasks=2)])
    log_probs = student.allocate(batch)
    assert log_probs.shape == (2, 5, 4)
    assert torch.allclose(log_probs[0].exp().sum(dim=-1), torch.ones(5), atol=1e-5)
    assert log_probs[0, :, 3].exp().max() == 0.0  # the first scene has no fourth drone
    assert denoised(student, batch, noise_for(batch)).shape == (2, 4, 64, 3)


@pytest.mark.parametrize("config", CONFIG_NAMES)
def test_padding_changes_nothing(config):
    student = tiny_student(config)
    small, large = taught_example("city", drones=3, tasks=5), taught_example("forest", drones=6, tasks=14, seed=3)
    alone, together = collate([small]), collate([small, large])
    noise = noise_for(together)
    assert torch.allclose(student.allocate(alone)[0], student.allocate(together)[0, :5, :3], atol=1e-5)
    padded = denoised(student, together, noise)[0, :3]
    assert torch.allclose(denoised(student, alone, noise[:1, :3])[0], padded, atol=1e-4)


@pytest.mark.parametrize("config", CONFIG_NAMES)
def test_relabelling_relabels_the_outputs(config):
    student = tiny_student(config)
    base = taught_example("city", drones=4, tasks=7)
    scene, rng = base.scene, np.random.default_rng(5)
    drones, tasks, obstacles = (rng.permutation(count) for count in (4, 7, len(scene.obstacles)))
    names = {int(old): new for new, old in enumerate(tasks)}
    routes = [tuple(names[task] for task in base.routes[i]) for i in drones]
    other = example(relabelled(scene, drones, tasks, obstacles), routes)
    one, two = collate([base]), collate([other])
    assert torch.allclose(student.allocate(one)[0][tasks][:, drones], student.allocate(two)[0], atol=1e-5)
    if student.settings.num_drone_slots:
        return  # the paper's learned drone embedding belongs to a place in the list
    noise = noise_for(one)
    assert torch.allclose(denoised(student, one, noise)[0][drones], denoised(student, two, noise[:, drones])[0], atol=1e-4)


def test_a_drone_on_its_own_is_denoised_as_in_its_fleet():
    student = tiny_student("small")
    batch = collate([taught_example("forest", drones=5, tasks=10, seed=1)])
    chosen = batch.ways.blocked.any(dim=-1)
    noise = noise_for(batch)
    ways, conditions = student.condition(batch, chosen.nonzero(as_tuple=True))
    with torch.inference_mode():
        alone = student.denoiser(noise[chosen][:, None], torch.full((len(ways.needs),), 500), conditions)
    assert bool(chosen.any()) and torch.allclose(alone[:, 0], denoised(student, batch, noise)[chosen], atol=1e-5)


def test_more_than_any_training_scene_has_still_works():
    scene = dataclasses.replace(taught_example("forest", drones=24, tasks=70).scene, name="large")
    batch = collate([example(scene, random_routes(scene, 2))])
    student = tiny_student("small")
    assert student.allocate(batch).shape == (1, 70, 24)
    assert torch.isfinite(denoised(student, batch, noise_for(batch))).all()


def test_an_open_sky_still_works():
    scene = dataclasses.replace(taught_example("forest").scene, obstacles=())
    batch = collate([example(scene, random_routes(scene, 0))])
    for config in CONFIG_NAMES:
        student = tiny_student(config)
        assert torch.isfinite(student.allocate(batch)).all()
        assert torch.isfinite(denoised(student, batch, noise_for(batch))).all()


def test_distances_and_normals_are_those_of_the_geometry():
    scene = taught_example("city").scene
    scene = dataclasses.replace(scene, obstacles=(*scene.obstacles, Sphere("ball", (1.0, 19.0, 4.0), 0.3)))
    points = np.random.default_rng(0).uniform((0, 0, 0), (20, 20, 5), (300, 3))
    table = torch.tensor(scene.obstacle_table, dtype=torch.float64)
    places = torch.tensor(points)[:, None]
    assert np.allclose(signed_distance(table, places), distances(scene.obstacle_table, points), atol=1e-5)
    expected = surface_normals(scene.obstacle_table, points)
    away = np.linalg.norm(outward(table, places).numpy() - expected, axis=-1)
    assert np.quantile(away, 0.99) < 1e-3  # at edges inside a box the two may choose different faces


def test_residuals_and_points_are_inverse_and_anchors_exact():
    batch = collate([taught_example("rooms", drones=3, tasks=6)])
    ways = batch.ways
    frames = leg_frames(ways)
    assert torch.allclose(frames @ frames.transpose(-1, -2), torch.eye(3).expand_as(frames), atol=1e-5)
    assert torch.allclose(to_points(ways, frames, to_residuals(ways, frames, ways.target)), ways.target, atol=1e-4)
    astray = to_points(ways, frames, torch.ones_like(ways.straight))
    places = torch.cat([ways.leg_begin, ways.leg_end], dim=-1)[..., None].expand(-1, -1, -1, 3)
    assert torch.equal(astray.gather(2, places), ways.straight.gather(2, places))


def test_mirroring_keeps_distances():
    batch = collate([taught_example("city", seed=seed) for seed in range(6)])
    mirrored = batch.mirrored(torch.Generator().manual_seed(3))
    before, after = (
        signed_distance(one.ways.obstacles[:, None, None], one.ways.target[..., None, :]) for one in (batch, mirrored)
    )
    near = before < 100.0  # padded obstacles are far away
    assert torch.allclose(before[near], after[near], atol=1e-3)
    assert not torch.allclose(batch.ways.straight, mirrored.ways.straight)


def test_anchors_sit_at_their_samples():
    one = taught_example("corridor", drones=4, tasks=9)
    for drone, route in enumerate(one.routes):
        places = np.unique(np.concatenate([one.leg_begin[drone], one.leg_end[drone]]))
        anchors = np.vstack([one.scene.starts[drone], one.scene.task_positions[list(route)]])
        assert np.array_equal(one.straight[drone, places], anchors) and np.array_equal(one.target[drone, places], anchors)


def test_too_many_anchors_are_refused():
    scene = taught_example("forest", drones=2, tasks=3).scene
    with pytest.raises(SettingsError, match=r"bundles\[0\].*3 legs"):
        example(scene, [(0, 1, 2), ()], num_samples=3)


@pytest.mark.parametrize(
    ("field", "value"), [("width", 100), ("patch", 5), ("frame", "body"), ("head", "oracle"), ("rounds", 0), ("blocks", 1.5)]
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(SettingsError, match=field if field != "patch" else "num_samples"):
        StudentSettings(**{**CONFIGS["small"].to_dict(), field: value})


@pytest.mark.parametrize("config", CONFIG_NAMES)
def test_saved_and_loaded_weights_give_equal_outputs(config, tmp_path):
    student = tiny_student(config)
    for name, value in student.state_dict().items():
        if name != "spread":
            value.copy_(value.bfloat16())  # what the file holds
    save_student(tmp_path / "student.safetensors", student.state_dict(), student.settings, {})
    loaded = load_student(tmp_path / "student.safetensors")
    batch = collate([taught_example("forest")])
    noise = noise_for(batch)
    assert torch.equal(student.allocate(batch), loaded.allocate(batch))
    assert torch.equal(denoised(student, batch, noise), denoised(loaded, batch, noise))


def test_weights_of_another_shape_are_refused(tmp_path):
    student = tiny_student("small")
    wrong = dataclasses.replace(student.settings, width=64)
    save_student(tmp_path / "student.safetensors", student.state_dict(), wrong, {})
    with pytest.raises(SettingsError, match="does not fit"):
        load_student(tmp_path / "student.safetensors")


def golden_record():
    """One output and one loss of the seeded tiny network of each configuration."""
    from learned.student.loss import LossWeights, StudentLoss

    record = {}
    for config in CONFIG_NAMES:
        student = tiny_student(config)
        batch = collate([taught_example("city", drones=3, tasks=5)])
        total, _ = StudentLoss(student)(batch, LossWeights(clearance=1.0), torch.Generator().manual_seed(7))
        output = denoised(student, batch, noise_for(batch))
        record[config] = {
            "loss": total.item(),
            "denoised": output[0, :, ::16].flatten().tolist(),
            "log_probs": student.allocate(batch)[0].flatten().tolist(),
        }
    return record


def test_outputs_are_the_golden_ones(root):
    golden = json.loads((root / "tests/golden/student.json").read_text(encoding="utf-8"))
    for config, values in golden_record().items():
        for name, value in values.items():
            assert np.allclose(value, golden[config][name], atol=2e-4), (config, name)
