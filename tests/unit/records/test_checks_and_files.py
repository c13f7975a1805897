"""Strict reading: what is refused, in which words, and writing whole or not at all."""

from __future__ import annotations

import dataclasses
import math
import os
import stat

import numpy as np
import pytest

from flockopt.errors import PlanError, SceneError, SettingsError
from flockopt.records import checks, files


@pytest.mark.parametrize("value", [3, 3.0, np.float64(3.0), np.int32(3), np.array(3.0)])
def test_numbers_of_any_kind_are_read(value):
    assert checks.number(SceneError, "x", value) == 3.0


@pytest.mark.parametrize("value", [True, "3", None, [3], {}, math.nan, math.inf, -math.inf, 10**400, np.array([3.0])])
def test_what_is_no_finite_number_is_refused(value):
    with pytest.raises(SceneError) as caught:
        checks.number(SceneError, "drones[3].radius", value)
    assert caught.value.field == "drones[3].radius"
    assert "finite number" in str(caught.value)


def test_limits_of_numbers_are_kept():
    assert checks.number(SceneError, "x", 0.0, least=0.0) == 0.0
    with pytest.raises(SceneError, match=r"x is 0; must be a finite number > 0"):
        checks.number(SceneError, "x", 0, above=0.0)
    with pytest.raises(SceneError, match=r"x is -1e-09; must be a finite number >= 0"):
        checks.number(SceneError, "x", -1e-9, least=0.0)


def test_integers():
    assert checks.integer(SceneError, "n", 3.0, least=0) == 3
    for value in (3.5, -1, True, "3", math.nan):
        with pytest.raises(SceneError):
            checks.integer(SceneError, "n", value, least=0)


def test_points_have_three_numbers():
    assert checks.point(SceneError, "p", np.array([1.0, 2.0, 3.0])) == (1.0, 2.0, 3.0)
    for value in ("abc", b"abc", [1, 2], [1, 2, 3, 4], {"x": 1, "y": 2, "z": 3}, None, 7):
        with pytest.raises(SceneError, match="three numbers"):
            checks.point(SceneError, "p", value)
    with pytest.raises(SceneError, match=r"p\[1\] is nan"):
        checks.point(SceneError, "p", [0, math.nan, 0])


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, True, "0.5"])
def test_shares_are_from_0_to_1(value):
    assert [checks.share(SceneError, "x", share) for share in (0, 0.5, 1.0)] == [0.0, 0.5, 1.0]
    with pytest.raises(SceneError, match="x is "):
        checks.share(SceneError, "x", value)


def test_flags_are_true_or_false():
    assert checks.flag(SceneError, "x", True) is True
    for value in (1, 0, "true", None, [True]):
        with pytest.raises(SceneError, match=r"x is .*; must be true or false"):
            checks.flag(SceneError, "x", value)


def test_choices_are_among_what_is_known():
    assert checks.choice(SceneError, "law", "quintic", known={"quintic": 1}) == "quintic"
    for value in ("cubic", None, ["quintic"], {}, 1):
        with pytest.raises(SceneError, match=r"law is .*; must be one of quintic, ruckig; choose one"):
            checks.choice(SceneError, "law", value, known=("quintic", "ruckig"))


def test_what_is_checked_is_stored():
    @dataclasses.dataclass(frozen=True)
    class Settings:
        width: int = 128
        heads: int = 4
        rate: float = 1.0

        def __post_init__(self):
            checks.store(self, checks.integer, SettingsError, "width", "heads", least=1)
            checks.store(self, checks.number, SettingsError, "rate", above=0.0)

    made = Settings(128.0, np.int64(4), np.float32(0.5))
    assert [type(value) for value in dataclasses.astuple(made)] == [int, int, float]
    assert made == Settings(128, 4, 0.5)
    with pytest.raises(SettingsError, match=r"heads is 0; must be an integer >= 1"):
        Settings(heads=0)
    with pytest.raises(SettingsError, match="wdth is an unknown key; did you mean width"):
        checks.from_keys(SettingsError, Settings, {"wdth": 64})
    assert checks.from_keys(SettingsError, Settings, {"width": 64}) == Settings(64)


def test_text_is_unicode_and_not_empty():
    assert checks.text(SceneError, "id", "Żółw 7") == "Żółw 7"
    for value in ("", 7, None, "\ud800"):
        with pytest.raises(SceneError, match="id is"):
            checks.text(SceneError, "id", value)


def test_keys_are_exactly_the_known_ones():
    assert checks.keys(SceneError, {"a": 1}, ("a",), ("b",)) == {"a": 1}
    with pytest.raises(SceneError, match="a is missing"):
        checks.keys(SceneError, {"b": 1}, ("a",), ("b",))
    with pytest.raises(SceneError, match="colour is an unknown key; known keys are a, b"):
        checks.keys(SceneError, {"a": 1, "colour": 2}, ("a",), ("b",))
    with pytest.raises(SceneError, match=r"^7 is an unknown key; known keys are a"):
        checks.keys(SceneError, {7: 1}, ("a",))
    with pytest.raises(SceneError, match="must be an object"):
        checks.keys(SceneError, [], ("a",))


def test_a_misspelt_key_is_told_before_the_one_that_it_leaves_missing():
    with pytest.raises(SceneError) as caught:
        checks.keys(SceneError, {"id": "d0", "capcity": 2}, ("id", "capacity"))
    words = "capcity is an unknown key; did you mean capacity? known keys are id, capacity; remove it or correct its spelling"
    assert str(caught.value) == words


def test_errors_in_lists_carry_the_index():
    def build(item):
        return checks.number(PlanError, "weight", item, least=0.0)

    assert checks.objects(PlanError, "items", [1, 2], build) == (1.0, 2.0)
    with pytest.raises(PlanError, match=r"items\[1\]\.weight is -2"):
        checks.objects(PlanError, "items", [1, -2], build)
    with pytest.raises(PlanError, match="items is 'ab'; must be a list"):
        checks.objects(PlanError, "items", "ab", build)


def test_ids_are_unique():
    checks.unique(SceneError, "tasks", ["a", "b"])
    with pytest.raises(SceneError, match=r"tasks\[2\]\.id is 'a', the same as tasks\[0\]\.id"):
        checks.unique(SceneError, "tasks", ["a", "b", "a"])


@pytest.mark.parametrize("content", ["", "{", "{'a': 1}", "[" * 100_000, "1" * 5000, "\x00"])
def test_what_is_not_json_is_refused(content):
    with pytest.raises(SceneError, match=r"file\.json is not JSON"):
        files.parse_json(SceneError, content, "file.json")


def test_a_key_may_stand_once():
    with pytest.raises(SceneError, match="b stands twice"):
        files.parse_json(SceneError, '{"a": {"b": 1, "c": 2, "b": 1}}', "file.json")


def test_unreadable_files_are_named(tmp_path):
    latin = tmp_path / "latin.json"
    latin.write_bytes(b'{"name": "caf\xe9"}')
    for path, words in ((tmp_path / "none.json", "No such file"), (tmp_path, "Is a directory"), (latin, "not UTF-8")):
        with pytest.raises(SceneError, match=words) as caught:
            files.read_json(SceneError, path)
        assert str(path) in str(caught.value)


def test_long_values_are_shortened():
    assert len(checks.shown("x" * 1000)) == 60


def test_files_are_written_whole_with_ordinary_permissions(tmp_path):
    target = tmp_path / "a.json"
    files.write_whole(SceneError, target, "first, and longer")
    files.write_whole(SceneError, target, b"second")
    assert target.read_bytes() == b"second"
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(target.stat().st_mode) == 0o666 & ~mask
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch):
    target = tmp_path / "a.json"
    target.write_text("old")

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(SceneError, match="No space left on device"):
        files.write_whole(SceneError, target, "new")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.json"]


def test_outputs_that_cannot_be_written_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "none" / "a", tmp_path / "file" / "a", tmp_path / ("x" * 300)):
        with pytest.raises(SceneError) as caught:
            files.check_output(SceneError, path)
        assert str(path) in str(caught.value)
        assert "writable file" in str(caught.value)


def test_a_link_is_followed_not_replaced(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    files.write_whole(SceneError, tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"


def test_whole_numbers_are_not_rounded_on_the_way():
    assert checks.integer(SceneError, "n", 2**53 + 1, least=0) == 2**53 + 1
    with pytest.raises(SceneError, match=f"n is {2**53 + 1}; must be an integer from 0 to {2**53}"):
        checks.integer(SceneError, "n", 2**53 + 1, least=0, most=2**53)
    with pytest.raises(SceneError, match=r"x is 3; must be a finite number > 0 and <= 2"):
        checks.number(SceneError, "x", 3, above=0.0, most=2.0)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_byte_order_mark_is_no_fault(tmp_path, encoding):
    path = tmp_path / "file.json"
    path.write_text('{"name": "caf\u00e9"}', encoding=encoding)
    assert files.read_json(SceneError, path) == {"name": "caf\u00e9"}


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "latin-1"])
def test_other_encodings_are_refused(tmp_path, encoding):
    path = tmp_path / "file.json"
    path.write_text('{"name": "caf\u00e9"}', encoding=encoding)
    with pytest.raises(SceneError, match="is not UTF-8 text"):
        files.read_json(SceneError, path)
