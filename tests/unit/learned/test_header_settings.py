"""Settings in the headers of weight files: whole numbers may be written as 128.0; anything else of the wrong kind is named."""

from __future__ import annotations

import pytest

pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt.errors import SettingsError
from learned.networks.weight_files import save_weights
from learned.smoother import checkpoint as smoother
from learned.smoother.model import TimedNetwork
from learned.smoother.settings import TimedNetworkSettings
from learned.student import checkpoint as student
from learned.teacher.actors.networks import load_actor, make_actor
from tests.student_scenes import tiny_student

TINY = TimedNetworkSettings(width=32, blocks=1, heads=2)


def student_file(path, changes):
    one = tiny_student("small")
    save_weights(path, one.state_dict(), student.KIND, {"student": one.settings.to_dict() | changes})
    return student.load_student(path).settings.width, one.settings.width


def smoother_file(path, changes):
    weights = TimedNetwork(TINY).state_dict()
    save_weights(path, weights, smoother.KIND, {"network": TINY.to_dict() | changes})
    return smoother.load_timed(path).settings.width, TINY.width


def teacher_file(path, changes):
    save_weights(path, make_actor("teacher", 16).state_dict(), "teacher", {"width": 16} | changes)
    return load_actor("teacher", path).memory_width, 16


FILES = {"student": (student_file, "student."), "smoother": (smoother_file, "network."), "teacher": (teacher_file, "")}


@pytest.mark.parametrize("name", FILES)
def test_a_whole_number_may_be_written_with_a_point(name, tmp_path):
    write, _ = FILES[name]
    found, width = write(tmp_path / "a.safetensors", {})
    again, _ = write(tmp_path / "b.safetensors", {"width": float(width)})
    assert found == again == width and type(again) is int


@pytest.mark.parametrize("value", ["128.0", 128.5, True, None, [128]])
@pytest.mark.parametrize("name", FILES)
def test_a_width_of_the_wrong_kind_is_named(name, value, tmp_path):
    write, prefix = FILES[name]
    with pytest.raises(SettingsError) as caught:
        write(tmp_path / "a.safetensors", {"width": value})
    assert str(tmp_path / "a.safetensors") in caught.value.field and caught.value.field.endswith(f"{prefix}width")
    assert repr(value) in caught.value.value
    assert caught.value.rule and caught.value.mend


@pytest.mark.parametrize(("name", "field", "value"), [
    ("student", "fleet_attention", "no"), ("student", "fleet_attention", 1), ("student", "frame", ["leg"]),
    ("student", "head", None), ("smoother", "mode", True), ("smoother", "num_noise_levels", "many"),
])  # fmt: skip
def test_other_settings_of_the_wrong_kind_are_named(name, field, value, tmp_path):
    with pytest.raises(SettingsError, match=f"{field} is") as caught:
        FILES[name][0](tmp_path / "a.safetensors", {field: value})
    assert repr(value) in caught.value.value


@pytest.mark.parametrize("name", ["student", "smoother"])
def test_an_unknown_key_is_told_with_the_nearest_one(name, tmp_path):
    with pytest.raises(SettingsError, match="wdith is an unknown key; did you mean width"):
        FILES[name][0](tmp_path / "a.safetensors", {"wdith": 128})


def test_a_header_without_settings_is_named(tmp_path):
    save_weights(tmp_path / "a.safetensors", tiny_student("small").state_dict(), student.KIND, {})
    with pytest.raises(SettingsError, match=r"a\.safetensors: student is None; must be an object"):
        student.load_student(tmp_path / "a.safetensors")
