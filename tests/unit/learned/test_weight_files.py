"""Weight files: what is saved comes back, and nothing else is believed."""

from __future__ import annotations

import pytest

from flockopt import SettingsError
from learned.networks.weight_files import load_weights, save_weights, to_bytes, to_floats

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")
SETTINGS = {"width": 64, "scale": 0.5, "name": "tiny"}


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "tiny.safetensors"
    save_weights(path, {"a": torch.arange(6.0).reshape(2, 3), "b": torch.arange(4.0).reshape(2, 2).T}, "teacher", SETTINGS)
    return path


def refusal(path, kind="teacher"):
    with pytest.raises(SettingsError) as caught:
        load_weights(path, kind)
    return str(caught.value)


def test_what_is_saved_comes_back(saved):
    tensors, settings = load_weights(saved, "teacher")
    assert settings == SETTINGS
    assert torch.equal(tensors["a"], torch.arange(6.0).reshape(2, 3))
    assert torch.equal(tensors["b"], torch.tensor([[0.0, 2.0], [1.0, 3.0]]))


def test_a_missing_file_is_named(tmp_path):
    assert "nowhere.safetensors cannot be read" in refusal(tmp_path / "nowhere.safetensors")


def test_a_directory_is_no_file(tmp_path):
    assert str(tmp_path) in refusal(tmp_path)


@pytest.mark.parametrize("keep", [0, 4, 40, -1])
def test_a_damaged_file_is_named(saved, keep):
    saved.write_bytes(saved.read_bytes()[:keep])
    assert "damaged" in refusal(saved)


def test_a_pickle_is_refused(tmp_path):
    torch.save({"a": torch.ones(1)}, tmp_path / "pickled.safetensors")
    assert "damaged" in refusal(tmp_path / "pickled.safetensors")


def test_a_foreign_file_is_named(tmp_path):
    from safetensors.torch import save_file

    save_file({"a": torch.ones(1)}, tmp_path / "foreign.safetensors")
    assert "has the format None" in refusal(tmp_path / "foreign.safetensors")


def test_weights_of_another_kind_are_refused(saved):
    assert "is for 'teacher'; must be for 'magnnet'" in refusal(saved, "magnnet")


@pytest.mark.parametrize("header", ["{", "[1]"])
def test_settings_must_be_a_json_object(tmp_path, header):
    from safetensors.torch import save_file

    metadata = {"format": "flockopt.weights/1", "kind": "teacher", "settings": header}
    save_file({"a": torch.ones(1)}, tmp_path / "bad.safetensors", metadata)
    assert "must be" in refusal(tmp_path / "bad.safetensors")


def test_weights_that_are_not_finite_are_refused(tmp_path):
    save_weights(tmp_path / "nan.safetensors", {"good": torch.ones(1), "bad": torch.tensor([0.0, torch.nan])}, "teacher", {})
    assert "'bad' with NaN" in refusal(tmp_path / "nan.safetensors")


def test_settings_that_are_not_json_are_refused_before_writing(tmp_path):
    with pytest.raises(SettingsError, match="settings cannot be written"):
        save_weights(tmp_path / "x.safetensors", {}, "teacher", {"scale": float("nan")})
    assert not list(tmp_path.iterdir())


def test_bytes_lose_little_and_only_of_matrices():
    matrix = torch.randn(6, 40, generator=torch.Generator().manual_seed(0)) * torch.logspace(-3, 3, 6)[:, None]
    tensors = {"matrix": matrix, "vector": torch.arange(3.0), "nothing": torch.zeros(2, 2)}
    stored = to_bytes(tensors)
    assert stored["matrix/rows"].dtype is torch.int8 and torch.equal(stored["vector"], tensors["vector"])
    back = to_floats(stored)
    assert back.keys() == tensors.keys()
    assert ((back["matrix"] - matrix).abs() <= matrix.abs().amax(dim=1, keepdim=True) / 253).all()
    assert torch.equal(back["nothing"], tensors["nothing"]) and torch.equal(to_floats(tensors)["matrix"], matrix)
