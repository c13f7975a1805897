"""Training: the scene pool, settings, checkpoints that go on exactly, and that something is learned."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flockopt import SettingsError

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.networks.weight_files import load_weights  # noqa: E402
from learned.teacher.problems import random_problems  # noqa: E402 - torch may be missing
from learned.teacher.train import main  # noqa: E402
from learned.teacher.training import scene_pool  # noqa: E402
from learned.teacher.training.run import Training, final_weights  # noqa: E402
from learned.teacher.training.scene_pool import POOL_DRONES, POOL_TASKS, ScenePool, build_pool  # noqa: E402
from learned.teacher.training.settings import AllocatorTrainingSettings  # noqa: E402
from learned.teacher.training.validation import ValidationSet, optimal_one_task_cost  # noqa: E402


@pytest.fixture(scope="module")
def pool():
    """A pool without obstacles, so that it is made at once."""
    problems = random_problems(6, POOL_DRONES, POOL_TASKS, torch.Generator().manual_seed(0))
    return ScenePool(problems.starts, problems.tasks, problems.start_task, problems.task_task[:, 0])


@pytest.fixture(scope="module")
def validation():
    problems = random_problems(20, 10, 20, torch.Generator().manual_seed(1))
    return ValidationSet(problems, None, problems.start_task.amin(dim=1).sum(dim=1))


def tiny(**changes):
    defaults = {"iterations": 12, "batch_size": 16, "num_epochs": 1, "num_minibatches": 2, "width": 16}
    return AllocatorTrainingSettings(**{**defaults, **changes})


def trained(settings, pool, folder, validation, **limits):
    folder.mkdir(exist_ok=True)
    training = Training(settings, pool, folder, validation)
    training.run(**limits)
    return training


@pytest.mark.parametrize("method", ["teacher", "magnnet"])
def test_a_stopped_training_goes_on_exactly(pool, validation, tmp_path, method):
    settings = tiny(method=method)
    whole = trained(settings, pool, tmp_path / "whole", validation)
    trained(settings, pool, tmp_path / "parts", validation, stop_at=11)  # the last checkpoint is at 10
    resumed = trained(settings, pool, tmp_path / "parts", validation)
    assert resumed.history == whole.history
    assert len(whole.history) == 12
    first, _ = load_weights(final_weights(tmp_path / "whole", method), method)
    again, header = load_weights(final_weights(tmp_path / "parts", method), method)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert header["training"]["batch_size"] == 16
    lines = (tmp_path / "parts/history.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == whole.history


def test_seeds_differ(pool, validation, tmp_path):
    one, other = (trained(tiny(seed=seed, iterations=1), pool, tmp_path / str(seed), validation) for seed in (0, 1))
    assert one.history != other.history


def test_a_folder_keeps_its_settings(pool, validation, tmp_path):
    trained(tiny(iterations=10), pool, tmp_path, validation)
    with pytest.raises(SettingsError, match="other settings"):
        trained(tiny(iterations=11), pool, tmp_path, validation)


def test_a_damaged_checkpoint_is_named(pool, validation, tmp_path):
    trained(tiny(iterations=10), pool, tmp_path, validation)
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(SettingsError, match=r"checkpoint\.safetensors is damaged"):
        Training(tiny(iterations=10), pool, tmp_path, validation)


def test_a_lost_history_is_named(pool, validation, tmp_path):
    trained(tiny(iterations=10), pool, tmp_path, validation)
    (tmp_path / "history.jsonl").unlink()
    with pytest.raises(SettingsError, match=r"history\.jsonl cannot be read"):
        Training(tiny(iterations=10), pool, tmp_path, validation)


def test_a_few_iterations_teach_something(pool, validation, tmp_path):
    settings = tiny(iterations=6, batch_size=48, num_epochs=2, width=32)
    training = Training(settings, pool, tmp_path, validation)
    before, _ = validation.excess(training.actor)
    training.run()
    assert validation.excess(training.actor)[0] < 0.7 * before


def test_draws_are_parts_of_pool_scenes(pool):
    problems = pool.draw(20, 4, 7, torch.Generator().manual_seed(2))
    assert problems.start_task.shape == (20, 4, 7)
    legs = (problems.starts[:, :, None] - problems.tasks[:, None]).norm(dim=3)
    assert torch.allclose(problems.start_task, legs, atol=1e-3)
    assert torch.allclose(problems.task_task[:, 0], torch.cdist(problems.tasks, problems.tasks), atol=0.05)


def test_a_pool_is_made_once_and_damage_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_pool, "FAMILIES", ("forest",))
    monkeypatch.setattr(scene_pool, "SHARD_SCENES", 1)
    build_pool(tmp_path, num_shards=1)
    (path,) = tmp_path.iterdir()
    made = path.stat().st_mtime_ns
    build_pool(tmp_path, num_shards=1)
    assert path.stat().st_mtime_ns == made
    assert ScenePool.load(tmp_path).start_task.shape == (1, POOL_DRONES, POOL_TASKS)
    np.savez(path, **{name: np.zeros((1, 2), np.float32) for name in scene_pool.SHAPES})
    with pytest.raises(SettingsError, match="holds 'starts' of float32"):
        ScenePool.load(tmp_path)
    path.write_bytes(b"nothing")
    with pytest.raises(SettingsError, match=r"forest-000\.npz is damaged"):
        ScenePool.load(tmp_path)


def test_an_empty_pool_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="holds no scenes"):
        ScenePool.load(tmp_path)


@pytest.mark.parametrize(
    ("field", "value"),
    [("method", "sarsa"), ("seed", -1), ("iterations", 0), ("clip", float("nan")), ("pool_share", 1.5), ("width", "wide")],
)
def test_settings_are_checked(field, value):
    with pytest.raises(SettingsError, match=f"{field} is"):
        AllocatorTrainingSettings(**{field: value})


def test_unknown_settings_are_refused():
    with pytest.raises(SettingsError, match="patience is an unknown key"):
        AllocatorTrainingSettings.from_dict({"patience": 3})


def test_the_optimal_one_task_assignment_by_hand():
    assert optimal_one_task_cost(np.array([[1.0, 2.0, 9.0], [1.0, 4.0, 9.0]])) == 3.0


def test_bad_words_on_the_command_line(tmp_path, capsys):
    assert main(["--out", str(tmp_path), "--method", "sarsa"]) == 2
    assert "method is 'sarsa'" in capsys.readouterr().err
    assert main(["--out", str(tmp_path), "--clip", "-1"]) == 2
    assert "clip is -1" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
