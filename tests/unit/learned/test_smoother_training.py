"""Training of timed flights: it learns, goes on exactly, and its files are its own."""

from __future__ import annotations

import dataclasses

import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt import SettingsError  # noqa: E402 - torch may be missing
from learned.networks.checkpoint import restore, save_checkpoint  # noqa: E402
from learned.smoother import train  # noqa: E402
from learned.smoother.batch import unit_stage  # noqa: E402
from learned.smoother.checkpoint import load_timed, save_timed  # noqa: E402
from learned.smoother.settings import TimedNetworkSettings, TimedTrainingSettings  # noqa: E402
from learned.smoother.train import TimedTrainer, main, measure  # noqa: E402
from tests.timed_stages import records  # noqa: E402

SHORT = TimedTrainingSettings(
    steps=40, stages_per_step=4, warmup_steps=5, learning_rate=3e-3, ema_decay=0.8, room_m=0.0, precision="float32"
)


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """The network made tiny."""
    monkeypatch.setattr(train, "TimedNetworkSettings", lambda mode: TimedNetworkSettings(mode, width=32, blocks=1, heads=2))


@pytest.fixture(scope="module")
def stages():
    return [unit_stage(record) for record in records("forest", drones=4, tasks=6, seed=5)]


def test_a_tiny_network_learns_a_few_stages(stages):
    trainer = TimedTrainer(SHORT, stages)
    first = trainer.advance()["total"]
    losses = [trainer.advance()["total"] for _ in range(24)]
    assert min(losses[-5:]) < first - 0.02
    assert measure(trainer.averaged(), stages)["raw_cost"] < 0.98


def test_a_run_goes_on_with_the_same_weights(stages, tmp_path):
    settings = dataclasses.replace(SHORT, steps=4)
    whole, first, second = (TimedTrainer(settings, stages) for _ in range(3))
    for _ in range(4):
        whole.advance()
    for _ in range(2):
        first.advance()
    path, terms = tmp_path / "checkpoint.safetensors", settings.to_dict()
    save_checkpoint(path, first.network, first.average, first.optimiser, {"training": terms, "step": 2})
    second.step = restore(path, second.network, second.average, second.optimiser, terms)
    for _ in range(2):
        second.advance()
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name
        assert torch.equal(whole.average[name], second.average[name]), name
    with pytest.raises(SettingsError, match="other settings"):
        restore(path, second.network, second.average, second.optimiser, {**terms, "seed": 1})


def test_weights_are_averaged_the_less_the_earlier(stages):
    trainer = TimedTrainer(SHORT, stages)
    expected = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    for step in (1, 2, 3):
        trainer.advance()
        decay = min(SHORT.ema_decay, (1 + step) / (10 + step))
        for name, value in trainer.network.state_dict().items():
            expected[name] = decay * expected[name] + (1.0 - decay) * value
    for name, value in trainer.averaged().state_dict().items():
        assert torch.allclose(value, expected[name], atol=1e-6), name


def test_saved_weights_answer_alike(stages, tmp_path):
    network = TimedTrainer(SHORT, stages).averaged()
    for parameter in network.parameters():
        parameter.data.copy_(parameter.data.to(torch.bfloat16))
    save_timed(tmp_path / "a.safetensors", network.state_dict(), network.settings, {"steps": 0})
    again = load_timed(tmp_path / "a.safetensors")
    assert measure(again, stages) == measure(network.eval(), stages)


def test_damaged_and_foreign_weights_are_named(stages, tmp_path):
    path = tmp_path / "a.safetensors"
    network = TimedTrainer(SHORT, stages).network
    save_timed(path, network.state_dict(), dataclasses.replace(network.settings, width=64), {})
    with pytest.raises(SettingsError, match="does not fit"):
        load_timed(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SettingsError, match="damaged"):
        load_timed(path)
    with pytest.raises(SettingsError, match="cannot be read"):
        load_timed(tmp_path / "nowhere")


def test_a_run_begins_with_weights_of_its_own_mode_only(stages, tmp_path):
    path, given = tmp_path / "a.safetensors", TimedTrainer(dataclasses.replace(SHORT, seed=3), stages).network
    save_timed(path, given.state_dict(), given.settings, {})
    trainer = TimedTrainer(SHORT, stages)
    assert len(trainer.begin_with(path, load_timed)) == 64  # a digest: a run on other weights of this name is another run
    assert all(torch.equal(value, load_timed(path).state_dict()[name]) for name, value in trainer.average.items())
    with pytest.raises(SettingsError, match="begin_with"):
        TimedTrainer(dataclasses.replace(SHORT, mode="diffusion"), stages).begin_with(path, load_timed)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"steps": 0}, "steps is 0"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"ema_decay": 1.5}, "ema_decay is 1.5"),
        ({"mode": "guessing"}, "mode is 'guessing'"),
        ({"room_m": -0.1}, "room_m is -0.1"),
    ],
)
def test_bad_settings_are_named(settings, words):
    with pytest.raises(SettingsError, match=words):
        TimedTrainingSettings(**settings)


def test_bad_input_on_the_command_line_is_named(tmp_path, capsys):
    assert main(["--data", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "must be a folder with shards" in capsys.readouterr().err
    assert main(["--data", str(tmp_path), "--out", str(tmp_path / "other"), "--steps", "-1"]) == 2
    assert "steps is -1" in capsys.readouterr().err
