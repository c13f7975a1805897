"""Compiled code on disk: found again, told from other code, passed over where it is damaged, and done without."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from numba import config, njit, types

from flockopt.batches import kept
from flockopt.batches.compiled import FLOATS_1, compiled_for, compiled_lazily, record_of
from flockopt.batches.kept import digest_of

pytestmark = pytest.mark.skipif(bool(config.DISABLE_JIT), reason="nothing is compiled")

MODULE = """
from numba import types
from flockopt.batches.compiled import compiled_for, compiled_lazily

FACTOR = {factor}

@compiled_lazily()
def inner(x):
    return {inner}

@compiled_for(types.float64)
def outer(x):
    return FACTOR * inner(x)

compiled = []
from numba.core import event
class Told(event.Listener):
    def on_start(self, event): pass
    def on_end(self, event): compiled.append(event.data["dispatcher"].py_func.__qualname__)
event.register("numba:compile", Told())
print(outer(3.0), *compiled)
"""


@pytest.fixture
def run(tmp_path):
    """Runs the module in a new process, which keeps what it compiles in a folder of the test's."""

    def run(factor=2.0, inner="x + 1.0", **environment):
        (tmp_path / "some_code.py").write_text(MODULE.format(factor=factor, inner=inner), encoding="utf-8")
        places = {"NUMBA_CACHE_DIR": str(tmp_path / "kept")} | environment
        command = [sys.executable, "-c", "import some_code"]
        path = os.pathsep.join([str(tmp_path), *sys.path])
        done = subprocess.run(
            command, env={**os.environ, **places, "PYTHONPATH": path}, capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    run.files = lambda: sorted((tmp_path / "kept" / "flockopt").glob("some_code*"))
    return run


def test_what_was_compiled_is_found_again_and_a_change_is_seen_wherever_it_is(run):
    assert run() == ["8.0", "inner", "outer"]
    assert run() == ["8.0"]
    assert run(factor=3.0) == ["12.0", "outer"]
    assert run(inner="x + 2.0") == ["10.0", "inner", "outer"]  # outer holds what inner was
    assert run() == ["8.0"]


@pytest.mark.parametrize("damage", [b"", b"\x80\x05nonsense", b"cos\nno_such_name\n."])
def test_damaged_files_are_passed_over_and_made_anew(run, damage):
    run()
    assert len(run.files()) == 2
    for file in run.files():
        file.write_bytes(damage)
    assert run() == ["8.0", "inner", "outer"]
    assert run() == ["8.0"]


def test_a_truncated_file_is_passed_over(run):
    run()
    for file in run.files():
        file.write_bytes(file.read_bytes()[:-100])
    assert run() == ["8.0", "inner", "outer"]


def test_without_a_home_the_temporary_directory_serves_and_without_that_nothing_is_kept(run, tmp_path):
    nowhere = {"NUMBA_CACHE_DIR": "", "XDG_CACHE_HOME": "/proc/nowhere", "HOME": "/proc/nowhere"}
    (tmp_path / "temporary").mkdir()
    for words in (["8.0", "inner", "outer"], ["8.0"]):
        assert run(**nowhere, TMPDIR=str(tmp_path / "temporary")) == words
    assert [folder.name for folder in (tmp_path / "temporary").iterdir()] == [f"flockopt-{os.getuid()}"]
    for _ in range(2):
        assert run(NUMBA_CACHE_DIR="/proc/nowhere") == ["8.0", "inner", "outer"]


def test_a_folder_that_others_may_write_to_is_not_trusted(run, tmp_path):
    folder, temporary = tmp_path / "home" / "flockopt", tmp_path / "temporary"
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    temporary.mkdir()
    places = {"NUMBA_CACHE_DIR": "", "XDG_CACHE_HOME": str(tmp_path / "home"), "TMPDIR": str(temporary)}
    assert run(**places) == ["8.0", "inner", "outer"]
    assert not any(folder.iterdir())
    assert run(**places) == ["8.0"]


def test_what_an_image_comes_with_can_be_read_by_other_users(run):
    run()
    assert [file.stat().st_mode & 0o777 for file in run.files()] == [0o644, 0o644]


def test_what_nobody_uses_is_removed(tmp_path, monkeypatch):
    old, new = tmp_path / "flockopt" / "old", tmp_path / "flockopt" / "new"
    old.parent.mkdir(mode=0o700)
    for file in (old, new):
        file.write_bytes(b"")
    os.utime(old, (0.0, 0.0))
    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert kept.place.__wrapped__() == tmp_path / "flockopt"
    assert new.exists() and not old.exists()


def made(size, fields=("x", "y")):
    from collections import namedtuple

    record = record_of(namedtuple("Record", fields), types.float64, types.float64)

    @compiled_for(record, FLOATS_1)
    def function(one, numbers):
        return one[0] + numbers[size]

    return function


def test_digests_tell_captured_values_and_records_apart():
    assert digest_of(made(1)) == digest_of(made(1))
    assert digest_of(made(1)) != digest_of(made(2))
    assert digest_of(made(1)) != digest_of(made(1, ("x", "z")))


def test_digests_know_options_and_functions_that_call_themselves():
    def function(n):
        return 1 if n < 2 else n * function(n - 1)

    plain, other = compiled_lazily()(function), compiled_lazily(error_model="numpy")(function)
    assert digest_of(plain) != digest_of(other)
    function = njit(function)
    assert len(digest_of(compiled_lazily()(lambda n: function(n)))) == 64
