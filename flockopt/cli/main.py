"""The command line: what it accepts, and what its exit statuses mean."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import NoReturn

from flockopt.cli.status import run_command
from flockopt.errors import SettingsError

__all__ = ["main"]

STATUSES = """exit status: 0 all is well; 1 a plan is not certified, a scene is infeasible, or a plan does not fit the
device (the output says why); 2 bad input (one line on stderr says what and how to mend it; nothing is written); 3 the machine
or the program fails (one line says how); 130 interrupted from the keyboard"""

PLAN_EXAMPLES = """examples:
  flockopt plan scene.json -o plan.json
  flockopt plan scene.json -o plan.json --show plan.png --show plan.html
  flockopt plan scene.json -o plan.json --time-limit 5 --bound tight --seed 3
  flockopt plan scene.json -o plan.json --planner exact    the least travel, with a proof that verify checks again"""

PLAN_MANY_EXAMPLES = """Plans every scene, each for itself, and writes to the folder DIR
  rows.jsonl    a line of JSON a scene, as it is done: name, file, digest, planner, seed, status, certified, tasks not served,
                cost, bound, gap, makespan, reason, seconds by stage
  rows.csv      the same as a table, in the order of the scenes, when all are done
  plans/        with --keep-plans, a plan file a scene
A scene that cannot be read or planned is a row with the reason, and stops no other. Stopped by Ctrl-C or killed, the same
command goes on where it stopped, and tries again what gave an error. The same seed gives the same rows, but for seconds,
whatever --jobs is; only a time limit makes them depend on the machine. Planners with networks answer many scenes at once
where there is no time limit.

examples:
  flockopt plan-many scenes/ --out runs/first
  flockopt plan-many scenes/*.json --planner classical --jobs 4 --out runs/classical --keep-plans
  flockopt plan-many scenes/ --planner teacher --seed 3 --jobs 2 --out runs/teacher
  flockopt plan-many scenes/ --workers dask --jobs 8 --out runs/dask    on the cluster of DASK_SCHEDULER_ADDRESS, else here"""

VERIFY_EXAMPLES = """Nothing in the plan's own certificate is believed: coverage, capacities, limits, clearances,
separations and the lower bound are computed anew, in continuous time, from the scene and the plan's polynomials.

examples:
  flockopt verify scene.json plan.json
  flockopt verify scene.json plan.json --engine fcl    clearance and separation by python-fcl's distances
  flockopt verify scene.json fleet/                    other people's trajectories, DRONE.csv each (docs/export.md)"""

SHOW_EXAMPLES = """examples:
  flockopt show scene.json -o scene.png
  flockopt show scene.json plan.json -o plan.png     top view, altitude, least distances over time
  flockopt show scene.json plan.json -o plan.html    a page that plays the flight, without a network"""

GENERATE_EXAMPLES = """examples:
  flockopt generate forest --drones 10 --tasks 20 --seed 0 -o forest.json
  flockopt generate city --drones 6 --tasks 40 --seed 7 -o city.json"""

EXPORT_EXAMPLES = """examples:
  flockopt export plan.json --to crazyswarm2 -o fleet                          a CSV a drone, crazyflies.yaml
  flockopt export plan.json --to qgroundcontrol --scene scene.json -o fleet    a mission a drone"""

COMPILE_EXAMPLES = """flockopt compiles its inner loops for the machine it runs on and keeps them in NUMBA_CACHE_DIR, else in
your cache directory, else in a temporary one; where nothing can be written, each process compiles for itself. The first plan
does so too, as far as it needs them; this does it beforehand, say while an image is built, by as many processes as there
are cores. Where all is compiled, it ends within seconds.

examples:
  flockopt compile
  NUMBA_CACHE_DIR=/opt/cache flockopt compile    and plan with the same NUMBA_CACHE_DIR"""


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line, as all others of flockopt are."""

    def error(self, message: str) -> NoReturn:
        words = re.sub(r"^argument ([^:]+): (?=is )", r"\1 ", message)
        words = re.sub(r"^argument ([^:]+): invalid choice: (.*) \(choose from (.*)\)$", r"\1 is \2; must be one of \3", words)
        raise SettingsError("", words, "", f"see {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: The arguments after the program's name; the process's own by default.

    Returns:
        The exit status: 0, 1, 2, 3 or 130, as in docs/formats.md.
    """
    return run_command("flockopt", lambda: _run(argv))


def _run(argv: Sequence[str] | None) -> int:
    options = _parser().parse_args(argv)
    status: int = options.run(options)
    return status


def _parser() -> argparse.ArgumentParser:
    from flockopt.cli import commands as work

    parser = _Parser(
        prog="flockopt", description="Plan drone fleets, with a certificate that anyone can check again.", epilog=STATUSES
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", dest="command", required=True, metavar="COMMAND")

    _add_plan(commands)
    _add_plan_many(commands)
    verify = _command(commands, "verify", "check a plan anew, clause by clause", VERIFY_EXAMPLES, work.verify)
    verify.add_argument("scene", metavar="SCENE", help="a flockopt.scene/1 file, or - for stdin")
    verify.add_argument(
        "plan", metavar="PLAN", help="a flockopt.plan/1 file, - for stdin, or trajectories: a CSV file, or a folder of them"
    )
    verify.add_argument(
        "--engine", default="closed-form", metavar="NAME", choices=("closed-form", "fcl"),
        help="what measures clearance and separation: closed-form or fcl (default: closed-form)",
    )  # fmt: skip

    show = _command(commands, "show", "draw a scene or a plan", SHOW_EXAMPLES, work.show)
    show.add_argument("scene", metavar="SCENE", help="a flockopt.scene/1 file, or - for stdin")
    show.add_argument("plan", metavar="PLAN", nargs="?", help="a flockopt.plan/1 file, or - for stdin")
    show.add_argument("-o", "--output", required=True, metavar="FILE", help="a .png picture or an .html page")

    generate = _command(commands, "generate", "make a scene from a family", GENERATE_EXAMPLES, work.generate)
    generate.add_argument("family", metavar="FAMILY", help="forest, corridor, warehouse, rooms or city")
    generate.add_argument("--drones", type=_whole(1), default=10, metavar="N", help="how many (default: 10)")
    generate.add_argument("--tasks", type=_whole(0), default=20, metavar="M", help="how many (default: 20)")
    generate.add_argument("--seed", type=_whole(0), default=0, metavar="K", help="same seed, same scene (default: 0)")
    generate.add_argument("-o", "--output", required=True, metavar="SCENE", help="where to write the scene, or - for stdout")

    export = _command(commands, "export", "write a plan for real drones", EXPORT_EXAMPLES, work.export)
    export.add_argument("plan", metavar="PLAN", help="a flockopt.plan/1 file, or - for stdin")
    export.add_argument(
        "--to", required=True, metavar="DEVICE", choices=("crazyswarm2", "qgroundcontrol"),
        help="for which device: crazyswarm2 or qgroundcontrol",
    )  # fmt: skip
    export.add_argument("--scene", metavar="SCENE", help="the plan's scene; qgroundcontrol needs it, with its origin")
    export.add_argument("-o", "--output", required=True, metavar="DIR", help="a new or empty directory, or an earlier export")

    summary = "compile what planning needs, once for a machine"
    compile_all = _command(commands, "compile", summary, COMPILE_EXAMPLES, work.compile_all)
    compile_all.add_argument("--quiet", action="store_true", help="print no progress and no count")
    compile_all.add_argument("--share", action="store_true", help=argparse.SUPPRESS)  # one of the processes that do it
    return parser


def _add_plan(commands: argparse._SubParsersAction) -> None:
    """The command ``plan`` and its options."""
    from flockopt.cli import commands as work

    plan = _command(commands, "plan", "plan a scene: routes, trajectories, certificate", PLAN_EXAMPLES, work.plan)
    plan.add_argument("scene", metavar="SCENE", help="a flockopt.scene/1 file, or - for stdin")
    plan.add_argument("-o", "--output", required=True, metavar="PLAN", help="where to write the plan, or - for stdout")
    _add_settings(plan)
    plan.add_argument("--show", action="append", default=[], metavar="FILE", help="draw it too: .png or .html; repeatable")
    plan.add_argument("--quiet", action="store_true", help="print no table and no progress")


def _add_plan_many(commands: argparse._SubParsersAction) -> None:
    """The command ``plan-many`` and its options."""
    from flockopt.cli import commands as work

    summary = "plan many scenes: a row each, by several workers"
    many = _command(commands, "plan-many", summary, PLAN_MANY_EXAMPLES, work.plan_many)
    many.add_argument(
        "scenes",
        nargs="+",
        metavar="SCENES",
        help="flockopt.scene/1 files, or folders of them (*.json, in order of their names)",
    )
    many.add_argument(
        "-o", "--out", required=True, metavar="DIR", help="folder for the rows: a new one, or that of a run to be continued"
    )
    _add_settings(many)
    many.add_argument("--jobs", type=_whole(1), default=1, metavar="N", help="scenes planned side by side (default: 1)")
    many.add_argument(
        "--workers", default="loky", metavar="NAME", choices=("loky", "threading", "dask", "ray"),
        help="who plans them: loky (processes, the default), threading, dask or ray",
    )  # fmt: skip
    many.add_argument("--keep-plans", action="store_true", help="write each plan as a plan file too")
    many.add_argument("--quiet", action="store_true", help="print no summary and no progress")


def _add_settings(plan: argparse.ArgumentParser) -> None:
    """Options that say how to plan."""
    plan.add_argument(
        "--planner", metavar="NAME",
        help="who proposes: classical (search), exact (the optimum, proven), ortools, or one that an installed package adds, "
        "such as hybrid, learned and teacher (default: the best that is ready)",
    )  # fmt: skip
    plan.add_argument(
        "--paths", default="any-angle", metavar="KIND",
        help="what drones fly along: any-angle, the shortest (default); some planners also know voxel26 and voxel6",
    )  # fmt: skip
    plan.add_argument("--time-limit", type=_seconds, metavar="S", help="seconds the whole plan may take (default: no limit)")
    plan.add_argument("--seed", type=_whole(0), default=0, metavar="N", help="same seed, same plan (default: 0)")
    plan.add_argument(
        "--bound", default="tight", metavar="KIND", choices=("fast", "tight", "exact"),
        help="how hard to work for the lower bound: fast, tight or exact (default: tight)",
    )  # fmt: skip
    plan.add_argument("--backend", metavar="NAME", help="what computes a planner's networks (default: the best installed)")
    plan.add_argument("--smooth", action="store_true", help="smooth the flights: done earlier, with less jerk (needs casadi)")
    plan.add_argument(
        "--tracking-margin", type=_metres, default=0.0, metavar="M",
        help="how far drones may stray in flight, metres: keep that much more clearance and twice that much more separation "
        "where there is room (default: 0)",
    )  # fmt: skip


def _command(
    commands: argparse._SubParsersAction, name: str, summary: str, examples: str, run: Callable[[argparse.Namespace], int]
) -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    command: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=summary, epilog=f"{examples}\n\n{STATUSES}", formatter_class=raw
    )
    command.set_defaults(run=run)
    return command


class _Version(argparse.Action):
    """Looks the version up only when asked."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        import flockopt

        print(f"flockopt {flockopt.__version__}")
        parser.exit()


def _whole(least: int) -> Callable[[str], int]:
    def convert(words: str) -> int:
        try:
            value = int(words)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"is {words!r}; must be an integer >= {least}; give a whole number")
        return value

    return convert


def _metres(words: str) -> float:
    try:
        value = float(words)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"is {words!r}; must be a finite number of metres >= 0; leave it out for none")
    return value


def _seconds(words: str) -> float:
    try:
        value = float(words)
    except ValueError:
        value = -1.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"is {words!r}; must be a finite number of seconds > 0; leave it out for no limit")
    return value
