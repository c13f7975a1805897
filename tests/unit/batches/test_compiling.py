"""Compiling beforehand: one signature a function, shares that do not overlap, and nothing left to compile afterwards."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit, types

import flockopt
from flockopt.batches import compiling
from flockopt.batches.compiled import FLOATS_1, INTEGERS_1, compiled_for, writable
from flockopt.planning.entries import EVERYTHING, JUDGING, PLANNING, entries_of

#: Answers as `serve` does, of functions that are never there.
ECHO = "import sys\nfor line in sys.stdin: print(line.strip() + '.inner'); print(flush=True)"
DEAD = "import sys; sys.exit(3)"

#: Plans, judges, smooths and proves in many ways; says what that compiled, and which entries were called by plain plans.
DO_EVERYTHING = """
import json
from dataclasses import replace
import numpy as np
from numba.core import event
from flockopt import Scene, Sphere, compute_travel, decode, generate, plan, refine_bundles, smooth
from flockopt.batches.compiled import ENTRIES

compiled = []

class Told(event.Listener):
    def on_start(self, event):
        pass

    def on_end(self, event):
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("flockopt."):
            compiled.append(f"{function.__module__}.{function.__qualname__}{event.data['args']}")

event.register("numba:compile", Told())
base = generate("forest", drones=4, tasks=6, seed=1)
homing = base.replace(drones=tuple(replace(drone, end="start") for drone in base.drones))
abilities = {"mass": 0.5, "max_thrust": 12.0, "max_tilt": 0.6}
scenes = [
    base,
    homing,
    base.replace(obstacles=()),
    generate("rooms", drones=3, tasks=5, seed=0),
    generate("warehouse", drones=3, tasks=5, seed=0),
    generate("city", drones=6, tasks=12, seed=0),
    base.replace(drones=tuple(replace(drone, velocity=(0.1, 0.0, 0.0)) for drone in base.drones)),
    base.replace(drones=tuple(replace(drone, **abilities) for drone in base.drones)),
    base.replace(drones=(replace(base.drones[0], radius=0.5 * base.drones[0].radius), *base.drones[1:])),
    base.replace(obstacles=(Sphere("ball", (0.0, 0.0, 1.0), 0.5), *base.obstacles)),
    Scene.load("examples/scenes/two-drones.json"),
    Scene.load("examples/scenes/rotterdam.json"),
]
for scene in scenes:
    plan(scene, planner="classical")
plain = [name for name, entry in ENTRIES.items() if entry.overloads]
plan(homing, planner="classical", bound="exact", tracking_margin_m=0.02)
travel = compute_travel(homing)
for method in ("exact", "lp", "search"):
    bundles = refine_bundles(homing, travel=travel, method=method)
for law in ("fly-through", "ruckig", "quintic"):
    flights = decode(homing, bundles, travel=travel, law=law)
samples = np.array([np.linspace(drone.start, base.task_positions[i], 12) for i, drone in enumerate(base.drones)])
decode(homing, bundles, samples, travel=travel, law="quintic")
smooth(homing, decode(homing, bundles, travel=travel))
print(json.dumps({"compiled": compiled, "plain": plain}))
"""


def test_all_kinds_of_arguments_are_one_signature():
    @compiled_for(FLOATS_1, types.int64)
    def entry(values, index):
        return values[index]

    @njit
    def caller(values):
        return entry(values, 0) + entry(values, len(values) - 1)

    values, frozen = np.array([1.0, 2.0]), np.array([3.0, 4.0])
    frozen.setflags(write=False)
    assert entry(values, 0) == 1.0
    assert entry(frozen, np.int32(1)) == 4.0
    assert caller(values) == 3.0
    assert caller(frozen) == 7.0
    assert len(entry.signatures) == 1


def test_what_is_written_to_must_be_writable():
    @compiled_for(writable(INTEGERS_1))
    def entry(values):
        values[0] = 5

    values = np.zeros(1, dtype=np.int64)
    entry(values)
    assert values[0] == 5
    values.setflags(write=False)
    with pytest.raises(TypeError):
        entry(values)


def test_every_module_with_entries_is_loaded_for_them():
    code = "from flockopt.planning.entries import *\nentries_of(EVERYTHING)\nimport sys\nprint(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    root = Path(flockopt.__file__).parent
    decorated = re.compile(r"^@compiled_for", re.MULTILINE)
    adding = [path for path in root.rglob("*.py") if decorated.search(path.read_text(encoding="utf-8"))]
    assert len(adding) > 10
    assert {".".join(path.relative_to(root.parent).with_suffix("").parts) for path in adding} <= set(loaded)


def test_entries_by_package():
    everything, planning, judging = (set(entries_of(packages)) for packages in (EVERYTHING, PLANNING, JUDGING))
    assert judging < planning < everything
    assert "flockopt.geometry.continuous.least_clearance" in judging
    assert "flockopt.bundles.exact.tails.grow_tails" in everything - planning


def test_functions_under_an_entry():
    under = compiling.functions_under(entries_of(JUDGING)["flockopt.geometry.continuous.curve_clear"])
    assert "flockopt.geometry.intervals.deviation" in under
    assert "flockopt.geometry.continuous.least_separation" not in under


def shares(code, under):
    with compiling._Processes([sys.executable, "-c", code], under) as processes:
        return list(processes.progress())[-1], processes


def test_processes_compile_everything_once():
    under = {name: {name, f"{name}.inner"} for name in "abcdef"}
    done, processes = shares(ECHO, under)
    assert done == set().union(*under.values())
    assert all(process.poll() is not None for process in processes._processes)


def test_what_shares_a_function_is_not_compiled_side_by_side():
    under = {"a": {"a", "shared"}, "b": {"b", "shared", "more"}, "c": {"c"}}
    processes = compiling._Processes([], under)
    assert processes._next(1) == "b"  # with most under it
    assert processes._next(2) == "c"
    processes._waiting.append("d")
    processes._under = {**under, "d": {"d"}}
    assert processes._next(3) == "d"  # and not a, until what it shares with b is there
    processes._note({"shared"})
    assert processes._next(2) == "a"
    processes._note({"b", "more", "a", "c", "d"})
    assert processes._next(1) is None


def test_processes_that_die_leave_the_work_undone():
    done, processes = shares(DEAD, {"a": {"a"}, "b": {"b"}})
    assert done == set()
    assert all(process.poll() == 3 for process in processes._processes)


def test_a_process_answers_what_it_is_asked(capsys):
    @njit  # not kept on disk
    def function(number):
        return number + 1

    entry = SimpleNamespace(compile=lambda: function.compile((types.int64,)))
    compiling.serve({"entry": entry}, ["entry\n", "entry\n"], sys.stdout)
    assert capsys.readouterr().out.splitlines() == [compiling._name(function), "", ""]


@pytest.mark.slow  # it compiles everything: minutes
def test_nothing_is_left_to_compile(root, tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(root)}

    def run(*arguments):
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=True)

    first, again = (run("-m", "flockopt", "compile") for _ in range(2))
    assert re.search(r"compiling for this machine, once: \d+ of \d+", first.stderr)
    assert re.fullmatch(r"\d+ functions are compiled for this machine: in .*\n", first.stdout)
    assert again.stdout == first.stdout
    assert again.stderr == ""
    done = json.loads(run("-c", DO_EVERYTHING).stdout)
    assert done["compiled"] == []
    assert set(done["plain"]) <= set(entries_of(PLANNING))


def test_without_a_compiler_there_is_nothing_to_compile():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "flockopt", "compile"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("nothing is compiled where NUMBA_DISABLE_JIT is set\n", "")


def test_no_entry_hands_a_record_back_to_python():
    """To make one, Python code would run inside compiled code, which an interrupt from the keyboard crashes."""

    def holds_record(kind):
        return isinstance(kind, types.BaseNamedTuple) or (isinstance(kind, types.BaseTuple) and any(map(holds_record, kind)))

    for name, entry in entries_of(EVERYTHING).items():
        entry.compile()
        assert not any(holds_record(signature.return_type) for signature in entry.nopython_signatures), name
