"""Exported directories: whole or not at all, and nobody's work lost."""

from __future__ import annotations

import json
import os

import pytest

from flockopt.errors import SettingsError
from flockopt.outputs.devices import directory
from flockopt.outputs.devices.directory import MANIFEST, check_directory, write_directory


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


@pytest.mark.parametrize("exists", [False, True])
def test_a_new_or_empty_directory_is_filled(tmp_path, exists):
    target = tmp_path / "out"
    if exists:
        target.mkdir()
    write_directory(target, {"a.csv": "1\n", "b.yaml": "é\n"}, {"to": "x"})
    held = contents(target)
    assert (held["a.csv"], held["b.yaml"]) == ("1\n", "é\n")
    assert json.loads(held[MANIFEST])["to"] == "x"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]
    assert target.stat().st_mode & 0o077 == 0o777 & ~current_umask() & 0o077


def current_umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_an_untouched_export_is_replaced(tmp_path):
    write_directory(tmp_path / "out", {"a.csv": "1\n", "b.csv": "2\n"}, {})
    write_directory(tmp_path / "out", {"a.csv": "3\n"}, {})
    assert set(contents(tmp_path / "out")) == {"a.csv", MANIFEST}
    assert contents(tmp_path / "out")["a.csv"] == "3\n"


def meddle_add(target):
    (target / "notes.txt").write_text("mine")


def meddle_change(target):
    (target / "a.csv").write_text("my radio addresses")


def meddle_remove(target):
    (target / "a.csv").unlink()


def meddle_manifest(target):
    (target / MANIFEST).write_text("[" * 100_000)


def meddle_listing(target):
    (target / MANIFEST).write_text(json.dumps({"format": "flockopt.export/1", "files": ["a.csv"]}))


@pytest.mark.parametrize("meddle", [meddle_add, meddle_change, meddle_remove, meddle_manifest, meddle_listing])
def test_what_people_changed_is_kept(tmp_path, meddle):
    target = tmp_path / "out"
    write_directory(target, {"a.csv": "1\n"}, {})
    meddle(target)
    before = contents(target)
    with pytest.raises(SettingsError, match="choose another path"):
        write_directory(target, {"a.csv": "2\n"}, {})
    assert contents(target) == before


def test_foreign_directories_and_files_are_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat.png").write_text("cat")
    (tmp_path / "file").write_text("x")
    for name in ("photos", "file", "missing/out"):
        with pytest.raises(SettingsError):
            check_directory(tmp_path / name)
    assert not (tmp_path / "missing").exists()


def test_a_failure_half_way_leaves_what_was_there(tmp_path, monkeypatch):
    target = tmp_path / "out"
    write_directory(target, {"a.csv": "1\n"}, {})
    replace, calls = os.replace, []

    def fails_second(source, destination):
        calls.append(source)
        if len(calls) == 2:
            raise OSError(28, "No space left on device")
        replace(source, destination)

    monkeypatch.setattr(directory.os, "replace", fails_second)
    with pytest.raises(SettingsError, match="No space left"):
        write_directory(target, {"a.csv": "2\n"}, {})
    assert contents(target)["a.csv"] == "1\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def test_a_link_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_directory(tmp_path / "link", {"a.csv": "1\n"}, {})
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real/a.csv").read_text() == "1\n"
