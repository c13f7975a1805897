"""What each command does: check everything, work, write, report."""

from __future__ import annotations

import argparse
import gc
import json
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockopt.batches.progress import StageLine
from flockopt.cli import text
from flockopt.errors import FieldError, MissingExtra, PlanError, SceneError, SettingsError
from flockopt.planning.entries import EVERYTHING, JUDGING, PLANNING, entries_of
from flockopt.records import files
from flockopt.records.status import Status
from flockopt.scene import Scene

if TYPE_CHECKING:
    from flockopt.certificate import Plan
    from flockopt.planning.settings import PlanSettings

#: Stands for stdin where a file is read, and for stdout where one is written.
STANDARD = "-"

__all__ = ["compile_all", "export", "generate", "plan", "plan_many", "show", "verify"]

#: Starts a process that compiles a share, see `flockopt.batches.compiling.serve`.
COMPILE_A_SHARE = (sys.executable, "-P", "-m", "flockopt", "compile", "--share")

#: New objects between two searches for garbage in such a process: numba makes many, and few are garbage.
OBJECTS = 50_000


def plan(options: argparse.Namespace) -> int:
    """Plan a scene, write the plan, draw it if asked: 0 when certified, 1 when not."""
    scene = _load_scene(options.scene)
    _check_outputs([("--output", options.output), *(("--show", path) for path in options.show)], [options.scene])
    for path in options.show:
        _check_drawable("--show", path)
    from flockopt.planning.pipeline import plan as plan_scene  # late: compiled code takes a second to load

    settings = _settings(options)
    with StageLine(quiet=options.quiet) as progress, _compiling(progress, PLANNING):
        result = plan_scene(scene, settings, progress=progress)
        _write(options.output, result)
        for path in options.show:
            progress(f"drawing {path}", 0.0)
            _draw(scene, path, result)
    if not options.quiet:
        text.emit(text.plan_report(scene, result), aside=options.output == STANDARD)
    return 0 if result.status == Status.CERTIFIED else 1


def plan_many(options: argparse.Namespace) -> int:
    """Plan many scenes, a row each: 0 when all are certified, 1 when not."""
    from flockopt.planning.many import TABLE, scene_files
    from flockopt.planning.many import plan_many as plan_scenes

    scenes = scene_files(*options.scenes)
    if os.path.realpath(options.out) in map(os.path.realpath, options.scenes):
        rule = "must not be a folder of scenes: what is written there would be taken for them"
        raise SettingsError("--out", f"is {options.out}", rule, "choose another folder")
    settings, report = _settings(options), text.RowsReport()
    rows = plan_scenes(
        scenes, settings, out=options.out, jobs=options.jobs, workers=options.workers, keep_plans=options.keep_plans,
        progress=not options.quiet,
    )  # fmt: skip
    with StageLine(quiet=options.quiet) as progress, _compiling(progress, PLANNING):
        for entry in entries_of(PLANNING).values():
            entry.compile()  # here, by all cores, and not by each worker
    for row in rows:
        report.add(row)
    if not options.quiet:
        text.emit(report.words(os.path.join(options.out, TABLE)))
    return 0 if report.is_certified else 1


def _settings(options: argparse.Namespace) -> PlanSettings:
    """How to plan, as the options say."""
    from flockopt.planning.settings import PlanSettings

    return PlanSettings(
        planner=options.planner, time_limit_s=options.time_limit, seed=options.seed, bound=options.bound,
        smoothing=options.smooth, tracking_margin_m=options.tracking_margin, paths=options.paths, backend=options.backend,
    )  # fmt: skip


def compile_all(options: argparse.Namespace) -> int:
    """Compile everything that is not compiled yet."""
    from flockopt.batches.compiling import functions_under, serve
    from flockopt.batches.kept import is_kept, place

    if options.share:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it ends it
        gc.set_threshold(OBJECTS)
        serve(entries_of(EVERYTHING), sys.stdin, sys.stdout)
        return 0
    with StageLine(quiet=options.quiet) as progress, _compiling(progress, EVERYTHING):
        entries = entries_of(EVERYTHING).values()
        for entry in entries:
            entry.compile()
    if not options.quiet and not entries:
        text.emit("nothing is compiled where NUMBA_DISABLE_JIT is set")
    elif not options.quiet:
        functions, folder = set().union(*map(functions_under, entries)), place()
        where = f"in {folder}" if is_kept() else "no directory can be written to, and they are gone when this process ends"
        text.emit(f"{len(functions)} functions are compiled for this machine: {where}")
    return 0


@contextmanager
def _compiling(progress: StageLine, packages: Sequence[str]) -> Iterator[None]:
    """Say what is compiled; where something in these packages is not, it all is, by as many processes as there are cores."""
    from flockopt.batches.compiling import compiling

    def tell(done: int, total: int) -> None:
        progress.tell(f"compiling for this machine, once: {done} of {total}", done / total)

    with compiling(lambda: entries_of(packages), COMPILE_A_SHARE, tell):
        yield


def verify(options: argparse.Namespace) -> int:
    """Check a plan against its scene: 0 when every clause holds, 1 when not."""
    _check_inputs(options.scene, options.plan)
    scene, is_trajectories = _load_scene(options.scene), os.path.isdir(options.plan) or options.plan.endswith(".csv")
    result = None if is_trajectories else _load_plan(options.plan)
    from flockopt.certificate.judge import certify

    with StageLine() as progress, _compiling(progress, JUDGING):
        if result is not None:
            text.emit(text.certificate_report(certificate := certify(scene, result, engine=options.engine)))
        else:
            from flockopt.outputs.devices.trajectories import load_trajectories
            from flockopt.travel.compute import compute_travel

            travel = compute_travel(scene)
            result, rounding = load_trajectories(scene, travel, options.plan)
            certificate = certify(scene, result, travel=travel, engine=options.engine, rounding=rounding)
            text.emit(text.trajectories_report(scene, result, rounding, certificate))
    return 0 if certificate.certified else 1


def show(options: argparse.Namespace) -> int:
    """Draw a scene, or a plan in its scene."""
    _check_inputs(options.scene, options.plan)
    scene = _load_scene(options.scene)
    result = None if options.plan is None else _load_plan(options.plan)
    if result is not None and result.scene_sha256 != scene.sha256:
        seen, rule = f"is {result.scene_sha256}", f"must be {scene.sha256}, the digest of {options.scene}"
        raise PlanError(f"{options.plan}: scene.sha256", seen, rule, "show the scene that the plan was made for")
    inputs = [path for path in (options.scene, options.plan) if path is not None]
    _check_outputs([("--output", options.output)], inputs)
    _check_drawable("--output", options.output)
    _draw(scene, options.output, result)
    return 0


def generate(options: argparse.Namespace) -> int:
    """Make a scene from a family's name and a seed."""
    from flockopt.scene.families.generate import generate as generate_scene

    _check_outputs([("--output", options.output)], [])
    scene = generate_scene(options.family, drones=options.drones, tasks=options.tasks, seed=options.seed)
    _write(options.output, scene)
    return 0


def export(options: argparse.Namespace) -> int:
    """Write a plan for real drones: 0 when written, 1 when it does not fit them."""
    _check_inputs(options.scene, options.plan)
    result = _load_plan(options.plan)
    scene = None if options.scene is None else _load_scene(options.scene)
    from flockopt.outputs.devices.export import export as export_plan

    try:
        outcome = export_plan(result, to=options.to, path=options.output, scene=scene)
    except SettingsError as fault:
        option = "--scene" if fault.field == "scene" else "--output"
        raise type(fault)(option, fault.value, fault.rule, fault.mend) from None
    except SceneError as fault:
        raise _in_file(fault, options.scene) from None
    except PlanError as fault:
        raise _in_file(fault, options.plan) from None
    text.emit(text.export_report(result, options.output, outcome))
    return 1 if outcome.misfits else 0


def _write(path: str, document: Scene | Plan) -> None:
    """Write a scene or a plan to a file, or to stdout."""
    if path == STANDARD:
        print(json.dumps(document.to_dict(), allow_nan=False), flush=True)
    else:
        document.save(path)


def _standard_input(error: type[FieldError]) -> Any:
    """The JSON document on stdin."""
    try:
        content = sys.stdin.buffer.read().decode(files.UTF_8)
    except UnicodeDecodeError as fault:
        raise error("", f"stdin is not UTF-8 text ({fault.reason})", "it must be UTF-8", "save it as UTF-8") from None
    return files.parse_json(error, content, "stdin")


def _load_scene(path: str) -> Scene:
    try:
        return Scene.from_dict(_standard_input(SceneError)) if path == STANDARD else Scene.load(path)
    except SceneError as fault:
        raise _in_file(fault, path) from None


def _load_plan(path: str) -> Plan:
    from flockopt.certificate import Plan

    try:
        return Plan.from_dict(_standard_input(PlanError)) if path == STANDARD else Plan.load(path)
    except PlanError as fault:
        raise _in_file(fault, path) from None


def _in_file(fault: SceneError | PlanError, path: str) -> SceneError | PlanError:
    """The same error with its file named, unless it is about the file as a whole and names it already."""
    if not fault.field and path in fault.value:
        return fault
    return type(fault)(f"{path}: {fault.field}" if fault.field else path, fault.value, fault.rule, fault.mend)


def _check_inputs(scene: str | None, plan: str | None) -> None:
    if scene == plan == STANDARD:
        raise SettingsError("SCENE", "is - and so is PLAN", "only one of them can be read from stdin", "name a file")


def _check_outputs(outputs: Sequence[tuple[str, str]], inputs: Sequence[str]) -> None:
    """Every output can be written, and none is an input or another output."""
    taken = {os.path.realpath(path): path for path in inputs if path != STANDARD}
    for option, path in outputs:
        if path == STANDARD and option == "--output":
            continue
        try:
            target = str(files.check_output(SettingsError, path))
        except SettingsError as fault:
            raise fault.within(option) from None
        if target in taken:
            raise SettingsError(option, f"is {path}", f"must not be {taken[target]} as well", "choose another path")
        taken[target] = path


def _check_drawable(option: str, path: str) -> None:
    from flockopt.outputs.pictures.drawing import SUFFIXES

    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise SettingsError(option, f"is {path}", f"must end in {' or '.join(SUFFIXES)}", "choose one of the two")
    if suffix == ".png" and find_spec("matplotlib") is None:
        raise MissingExtra("matplotlib", "show")


def _draw(scene: Scene, path: str, result: Plan | None) -> None:
    from flockopt.outputs.pictures.drawing import show as draw

    draw(scene, path=path, plan=result)
