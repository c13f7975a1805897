"""Loss, schedule and DDIM against references; training that learns, resumes exactly, and refuses what is not its own."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt import SettingsError  # noqa: E402 - torch may be missing
from flockopt.cli.status import INTERRUPTED  # noqa: E402 - torch may be missing
from flockopt.flights.waypoints import leg_clear  # noqa: E402
from learned.demonstrations.scenes import SceneMix  # noqa: E402
from learned.demonstrations.writing import DemonstrationSettings, demonstration_shards  # noqa: E402
from learned.networks import training as learner  # noqa: E402
from learned.networks.diffusion import add_noise, ddim, noise_levels, signal_levels  # noqa: E402
from learned.networks.schedule import LAST_RATE, Schedule  # noqa: E402
from learned.student import loss as loss_module  # noqa: E402
from learned.student import train  # noqa: E402
from learned.student.checkpoint import STORAGES, load_student, save_student  # noqa: E402
from learned.student.inference import draw  # noqa: E402
from learned.student.loss import (  # noqa: E402
    StudentLoss,
    allocation_loss,
    clearance_loss,
    detour_weights,
    diffusion_loss,
)
from learned.student.scenes.batch import collate  # noqa: E402
from learned.student.scenes.examples import example, with_ways  # noqa: E402
from learned.student.settings import CONFIGS  # noqa: E402
from learned.student.train import Trainer  # noqa: E402
from learned.student.training_settings import StudentTrainingSettings  # noqa: E402
from tests.student_scenes import TINY, random_routes, taught_example, tiny_student  # noqa: E402


@pytest.fixture
def tiny(monkeypatch):
    """The configurations made tiny."""
    monkeypatch.setattr(train, "CONFIGS", TINY)


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    """A folder with some demonstrations."""
    folder = tmp_path_factory.mktemp("demonstrations")
    demonstration_shards(folder, DemonstrationSettings(SceneMix(family="forest", usual_share=1.0), seed=3)).go(6)
    return folder


def test_allocation_loss_by_hand():
    log_probs = torch.tensor([[[0.5, 0.5], [0.2, 0.8], [0.9, 0.1]], [[0.3, 0.7]] * 3]).log()
    assignment = torch.tensor([[0, 1, -1], [0, 0, 0]])
    expected = -(np.log(0.5) + np.log(0.8)) / 2  # the third task is nobody's, the second scene teaches nothing
    assert float(allocation_loss(log_probs, assignment, torch.tensor([True, False]))) == pytest.approx(expected)


def test_diffusion_loss_by_hand():
    denoised, clean = torch.zeros(1, 3, 2, 3), torch.zeros(1, 3, 2, 3)
    denoised[0, 0] = 1.0  # 3 a sample
    denoised[0, 1, 0, 2] = 2.0  # 4 in one of two samples
    denoised[0, 2] = 99.0  # an inactive drone
    assert float(diffusion_loss(denoised, clean, torch.tensor([[1.0, 1.0, 0.0]]))) == pytest.approx((3.0 + 2.0) / 2)
    assert float(diffusion_loss(denoised, clean, torch.zeros(1, 3))) == 0.0


def test_clearance_loss_is_zero_on_roomy_ways_and_not_on_straight_ones():
    batch = collate([taught_example("forest", drones=5, tasks=10, seed=1)])
    assert bool(batch.ways.blocked.any())
    straight, roomy = (float(clearance_loss(batch.ways, points)) for points in (batch.ways.straight, batch.ways.target))
    assert straight > 10.0 * roomy
    below = batch.ways.target.clone()
    below[..., 2] = -1.0
    assert float(clearance_loss(batch.ways, below)) > 1.0


def test_schedule_and_ddim_are_those_of_diffusers():
    diffusers = pytest.importorskip("diffusers", reason="diffusers comes with the dependency group 'dev'")
    scheduler = diffusers.DDIMScheduler(
        num_train_timesteps=1000, beta_schedule="squaredcos_cap_v2", prediction_type="sample", clip_sample=False,
        timestep_spacing="trailing", set_alpha_to_one=True,
    )  # fmt: skip
    assert torch.allclose(signal_levels(1000)[1:], scheduler.alphas_cumprod, atol=1e-6)
    generator = torch.Generator().manual_seed(0)
    noise, clean = torch.randn(2, 8, 3, generator=generator), torch.randn(2, 8, 3, generator=generator)
    levels = torch.tensor([1, 700])
    expected = scheduler.add_noise(clean, noise, levels - 1)
    assert torch.allclose(add_noise(clean, noise, levels, 1000), expected, atol=1e-6)

    def denoise(noisy, level):
        return torch.tanh(noisy) * (1.0 + level.view(-1, 1, 1) / 1000)

    for steps in (1, 2, 5, 10):
        scheduler.set_timesteps(steps)
        assert [level - 1 for level in noise_levels(steps, 1000)[:-1]] == scheduler.timesteps.tolist()
        sample = noise
        for timestep in scheduler.timesteps:
            level = torch.full((len(noise),), int(timestep) + 1)
            sample = scheduler.step(denoise(sample, level), timestep, sample, eta=0.0).prev_sample
        assert torch.allclose(ddim(denoise, noise, steps, 1000), sample, atol=1e-4)


@pytest.mark.parametrize("steps", [0, 1001, 2.5])
def test_bad_numbers_of_steps_are_named(steps):
    with pytest.raises(SettingsError, match="steps"):
        noise_levels(steps, 1000)


@pytest.mark.parametrize("config", ["paper", "small", "small-regression"])
def test_a_tiny_network_overfits_eight_scenes(config, tiny, monkeypatch):
    examples = [taught_example("forest", drones=2, tasks=4, seed=seed) for seed in range(8)]
    settings = StudentTrainingSettings(
        config=config, steps=100, scenes_per_step=8, learning_rate=1e-2, warmup_steps=10, clearance_weight=0.0
    )
    trainer = Trainer(settings, examples)
    monkeypatch.setattr(train.FleetBatch, "mirrored", lambda batch, generator: batch)  # eight scenes, not sixty-four
    losses = [trainer.advance() for _ in range(settings.steps)]
    first, last = ({name: np.mean([one[name] for one in part]) for name in losses[0]} for part in (losses[:10], losses[-10:]))
    assert last["allocation"] < 0.6 * first["allocation"]
    assert last["diffusion"] < 0.6 * first["diffusion"]


def test_half_of_the_noise_levels_are_those_that_sampling_passes():
    loss, clean = StudentLoss(tiny_student("small")), torch.ones(400, 1, 4, 3)
    noisy, level = loss._noised(clean, torch.Generator().manual_seed(0))
    passed = (level == 1000) | (level == 500)
    assert 0.4 < passed.float().mean() < 0.6 and 0.3 < (level == 500)[passed].float().mean() < 0.7
    assert level.min() >= 1 and level.max() <= 1000
    assert noisy[level < 50].std() < 0.2 < noisy[level > 950].std()


def test_regression_is_trained_and_asked_without_noise(tiny):
    student = tiny_student("small-regression")
    noisy, level = StudentLoss(student)._noised(torch.ones(5, 1, 4, 3), torch.Generator())
    assert noisy.abs().max() == 0.0 and level.tolist() == [1000] * 5
    batch = collate([taught_example("forest", drones=3, tasks=9, seed=1)])
    scene, drone = batch.ways.blocked.any(dim=-1).nonzero(as_tuple=True)
    noise = torch.randn(2, len(scene), 64, 3)
    first, second = student.draw(batch, scene, drone, noise, steps=5)
    assert len(scene) and torch.equal(first, second)
    one = taught_example("forest", drones=3, tasks=9, seed=1)
    by_rows = [draw(student, [one], steps=5, tries=1, seed=seed)[0].samples for seed in (0, 1)]
    assert student.draws_rows and np.array_equal(*by_rows)


def test_the_learning_rate_rises_and_then_falls():
    schedule = Schedule(steps=100, warmup_steps=10, learning_rate=1.0, ema_decay=0.9)
    rates = [schedule.rate_at(step) for step in range(101)]
    assert rates[0] == 0.1 and rates[9] == max(rates) == 1.0
    assert rates[10:] == sorted(rates[10:], reverse=True) and rates[100] == pytest.approx(LAST_RATE)


def test_fine_tuning_goes_on_from_what_the_student_draws_itself():
    student = tiny_student("small")
    loss, batch = StudentLoss(student), collate([taught_example("forest", drones=3, tasks=9, seed=1)])
    ways, conditions = loss._ways(batch, student.encoder(batch))
    noisy, level = loss._own(torch.zeros(len(ways.needs), 1, 64, 3), conditions, torch.Generator().manual_seed(4))
    noise, seen = torch.randn(noisy.shape, generator=torch.Generator().manual_seed(4)), []

    def denoise(samples, at):
        seen.append((samples, at))
        return student.denoiser(samples, at, conditions)

    with torch.no_grad():
        ddim(denoise, noise, 2, 1000)
    assert torch.allclose(noisy, seen[1][0], atol=1e-5) and torch.equal(level, seen[1][1])


def test_filling_up_the_drones_changes_nothing(monkeypatch):
    student = tiny_student("small")
    batch = collate([taught_example("forest", drones=3, tasks=9, seed=1)])
    clean, conditions = {}, {}
    for step in (1, 32):
        monkeypatch.setattr(loss_module, "ROWS_STEP", step)
        ways, conditions[step] = StudentLoss(student)._ways(batch, student.encoder(batch))
        clean[step] = student.clean_samples(ways), detour_weights(student.clean_samples(ways), ways.active), ways
    (few, weights, ways), (many, filled_weights, filled) = clean[1], clean[32]
    assert len(few) < len(many) == 32 and filled_weights[len(few) :].abs().max() == 0.0
    assert float(diffusion_loss(few + 1.0, few, weights)) == pytest.approx(
        float(diffusion_loss(many + 1.0, many, filled_weights))
    )
    assert torch.allclose(clearance_loss(ways, ways.straight), clearance_loss(filled, filled.straight), rtol=1e-5)


def test_a_step_without_blocked_drones_teaches_allocation_only(tiny):
    scene = dataclasses.replace(taught_example("forest").scene, obstacles=())
    one = with_ways(example(scene, random_routes(scene, 0)), [[]] * scene.num_drones)
    terms = Trainer(StudentTrainingSettings(steps=1, scenes_per_step=2, clearance_from=0.0), [one]).advance()
    assert terms["diffusion"] == terms["clearance"] == 0.0 < terms["allocation"]


def test_a_step_in_bfloat16_is_nearly_one_in_float32(tiny):
    examples = [taught_example("forest", drones=3, tasks=9, seed=seed) for seed in range(2)]
    one, other = (
        Trainer(StudentTrainingSettings(steps=1, scenes_per_step=2, precision=precision), examples).advance()
        for precision in ("float32", "bfloat16")
    )
    assert one["total"] != other["total"] == pytest.approx(one["total"], rel=0.05)


@pytest.mark.slow
def test_two_processes_share_a_run(demonstrations, tmp_path, root):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m"]
    command += ["learned.student.train", "--data", str(demonstrations), "--out", str(tmp_path), "--steps", "2"]
    subprocess.run([*command, "--scenes-per-step", "4"], check=True, cwd=root, timeout=600)
    assert load_student(tmp_path / "student.safetensors").settings == CONFIGS["small"]


def test_demonstrations_become_valid_examples(demonstrations):
    from learned.demonstrations.shards import load_demonstrations

    for demonstration in load_demonstrations(demonstrations):
        one = train.example_of(demonstration, 64)
        assert one.scene == demonstration.scene()
        assert one.teaches_allocation is not demonstration.hard
        blocked = {drone for drone in np.flatnonzero(one.active) if one.blocked[drone].any()}
        for drone in np.flatnonzero(one.active):
            assert leg_clear(one.scene, drone, one.target[drone]) or drone in blocked
        assert not demonstration.hard or blocked


def run(demonstrations, out, *options):
    return train.main(["--data", str(demonstrations), "--out", str(out), "--scenes-per-step", "2", *options])


def test_a_run_that_is_stopped_ends_with_the_same_weights(demonstrations, tmp_path, tiny, monkeypatch):
    monkeypatch.setattr(learner, "CHECKPOINT_STEPS", 3)
    settings = ("--steps", "6", "--clearance-from", "0.5")
    assert run(demonstrations, tmp_path / "whole", *settings) == 0
    advance = Trainer.advance
    with monkeypatch.context() as patch:

        def stopping(self):
            if self.step == 4:
                raise KeyboardInterrupt
            return advance(self)

        patch.setattr(Trainer, "advance", stopping)
        assert run(demonstrations, tmp_path / "stopped", *settings) == INTERRUPTED
    assert run(demonstrations, tmp_path / "stopped", *settings) == 0
    whole, stopped = (load_student(tmp_path / name / "student.safetensors").state_dict() for name in ("whole", "stopped"))
    assert all(torch.equal(value, stopped[name]) for name, value in whole.items())
    assert list((tmp_path / "whole" / "log").glob("events*"))


def test_weights_can_be_tuned_further(demonstrations, tmp_path, tiny, capsys):
    assert run(demonstrations, tmp_path / "first", "--steps", "4", "--until", "2") == 0
    first = tmp_path / "first" / "student.safetensors"
    options = ("--begin-with", str(first), "--steps", "1", "--warmup-steps", "0", "--learning-rate", "1e-9")
    assert run(demonstrations, tmp_path / "second", *options) == 0
    before, after = (load_student(tmp_path / name / "student.safetensors").state_dict() for name in ("first", "second"))
    assert all(torch.allclose(value, after[name], atol=1e-2) for name, value in before.items())
    assert run(demonstrations, tmp_path / "third", "--config", "paper", *options) == 2
    assert "begin_with" in capsys.readouterr().err


def test_weights_stored_in_bytes_take_half_the_room_and_draw_the_same(demonstrations, tmp_path, tiny):
    assert run(demonstrations, tmp_path / "run", "--steps", "1", "--store-as", "int8") == 0
    small = tmp_path / "run" / "student.safetensors"
    student = tiny_student("paper")
    paths = {storage: tmp_path / storage for storage in STORAGES}
    for storage, path in paths.items():
        save_student(path, student.state_dict(), student.settings, {}, storage)
    assert paths["int8"].stat().st_size < 0.75 * paths["bfloat16"].stat().st_size  # tiny matrices have many scales
    batch = collate([taught_example("forest")])
    one, other = (load_student(path).allocate(batch) for path in paths.values())
    assert torch.allclose(one, other, atol=0.05)
    assert load_student(small).settings == TINY["small"]


def test_a_folder_with_another_run_is_refused(demonstrations, tmp_path, tiny, capsys):
    assert run(demonstrations, tmp_path, "--steps", "1") == 0
    assert run(demonstrations, tmp_path, "--steps", "2") == 2
    assert "out" in capsys.readouterr().err


def test_missing_data_is_named(tmp_path, capsys):
    assert run(tmp_path / "nowhere", tmp_path / "out", "--steps", "1") == 2
    assert "nowhere" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("field", "value"),
    [("config", "big"), ("steps", 0), ("learning_rate", float("nan")), ("ema_decay", 1.5), ("precision", "int8")],
)
def test_bad_training_settings_are_named(field, value):
    with pytest.raises(SettingsError, match=field):
        StudentTrainingSettings(**{field: value})


def test_the_clearance_penalty_begins_with_fine_tuning():
    settings = dataclasses.replace(StudentTrainingSettings(), steps=10, clearance_from=0.5)
    assert [settings.loss_weights(step).clearance > 0.0 for step in (0, 4, 5, 9)] == [False, False, True, True]
