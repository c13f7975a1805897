"""Plan and fly many scenes and say what came of it.

    python -m sim.evaluate --family forest --drones 10 --tasks 20 --scenes 100 --seed 0 --jobs 2 --out out/forest

Writes ``flights.csv`` (a row a flight, the same on every run), ``timings.csv``, ``summary.md``, ``summary.png`` and
``flight.gif``. Killed and started again, it goes on where it stopped. With ``--events N`` every flight is struck by N
disturbances and replanned. Exit status 0 if every flight was certified, complete and without contact, 1 if not, 2 on bad
input; after events complete means that every task was served or is listed with the reason.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flockopt import SettingsError
from flockopt.batches.backends import BACKENDS
from flockopt.batches.progress import ProgressBar
from flockopt.cli.status import run_command
from flockopt.planning.planners import ANY_ANGLE, find_planner
from flockopt.records import checks, files
from flockopt.scene.families.layouts import FAMILIES
from sim.mission.events import KINDS, EventSettings
from sim.movie import save_movie
from sim.physics.fleet import CONTROLLERS
from sim.physics.settings import FlightSettings
from sim.physics.vehicles import VEHICLES
from sim.physics.world import load_pybullet
from sim.trials.batch import run_batch
from sim.trials.journal import Journal
from sim.trials.summary import draw_summary, flawless, summary_text
from sim.trials.trial import TRACKING_MARGIN_M, Result, Trial

__all__ = ["add_event_options", "add_flight_options", "event_settings", "flight_settings", "main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    words = sys.argv[1:] if argv is None else list(argv)
    options = _parser().parse_args(words, argparse.Namespace(words=words))
    return run_command("sim.evaluate", lambda: _evaluate(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sim.evaluate", description=__doc__.split("\n")[0])
    parser.add_argument("--family", default="forest", help=f"of scenes: {', '.join(FAMILIES)} (default forest)")
    parser.add_argument("--drones", type=int, default=10, help="in each scene (default 10)")
    parser.add_argument("--tasks", type=int, default=20, help="in each scene (default 20)")
    parser.add_argument("--scenes", type=int, default=100, help="how many (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene; the others follow (default 0)")
    parser.add_argument("--planner", default="classical", help="who plans (default classical)")
    parser.add_argument(
        "--paths", default=ANY_ANGLE, help="what drones fly along (default any-angle; more if the planner knows them)"
    )
    parser.add_argument(
        "--time-limit", type=float, metavar="S", help="for each plan, seconds; results then vary with the machine"
    )
    parser.add_argument(
        "--tracking-margin", type=float, default=TRACKING_MARGIN_M, metavar="M",
        help=f"room that plans keep for tracking errors, metres (default {TRACKING_MARGIN_M:g})",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, help="flights side by side (default 1)")
    parser.add_argument("--backend", default="loky", help=f"where they run: {', '.join(BACKENDS)} (default loky: processes)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--no-movie", action="store_true", help="make no GIF of a flight")
    add_flight_options(parser)
    add_event_options(parser)
    return parser


def add_event_options(parser: argparse.ArgumentParser) -> None:
    """Options that say what happens in flight."""
    default = EventSettings()
    parser.add_argument("--events", type=int, default=0, metavar="N", help="disturbances that strike each flight (default 0)")
    parser.add_argument(
        "--event-kinds", nargs="+", default=list(KINDS), metavar="KIND", help=f"some of {', '.join(KINDS)} (default all)"
    )
    parser.add_argument(
        "--gust", type=float, default=default.gust_mps, metavar="MPS",
        help=f"speed of the air in a gust (default {default.gust_mps:g})",
    )  # fmt: skip


def event_settings(options: argparse.Namespace) -> EventSettings | None:
    """What the options of `add_event_options` ask for; None for nothing."""
    number = checks.integer(SettingsError, "events", options.events, least=0)
    settings = EventSettings(max(number, 1), tuple(options.event_kinds), gust_mps=options.gust)
    return settings if number else None


def add_flight_options(parser: argparse.ArgumentParser) -> None:
    """Options that say how to fly, and whether to fly what is not certified."""
    default = FlightSettings()
    parser.add_argument("--vehicle", help=f"for all drones: {', '.join(VEHICLES)} (default: by mass or radius)")
    parser.add_argument(
        "--controller", default=default.controller, help=f"{' or '.join(CONTROLLERS)} (default {default.controller})"
    )
    parser.add_argument("--physics-hz", type=float, default=default.physics_hz, help=f"default {default.physics_hz:g}")
    parser.add_argument(
        "--service-radius", type=float, default=default.service_radius, metavar="M",
        help=f"how near a drone must be to serve a task (default {default.service_radius:g})",
    )  # fmt: skip
    parser.add_argument("--no-drag", action="store_true", help="fly in empty space")
    parser.add_argument("--downwash", action="store_true", help="let drones feel the air that others above them blow down")
    parser.add_argument("--force", action="store_true", help="fly plans that are not certified too")


def flight_settings(options: argparse.Namespace) -> FlightSettings:
    """The settings that the options of `add_flight_options` stand for."""
    return FlightSettings(
        vehicle=options.vehicle, controller=options.controller, physics_hz=options.physics_hz,
        service_radius=options.service_radius, has_drag=not options.no_drag, has_downwash=options.downwash,
    )  # fmt: skip


def _evaluate(options: argparse.Namespace) -> int:
    trials = _trials(options)
    with Journal(options.out, trials[0].terms()) as journal:
        bar = ProgressBar(len(trials), sum(trial.key in journal for trial in trials))

        def done(result: Result) -> None:
            bar.advance(f"{result.key} {result.row['status']}")

        run_batch(trials, journal, jobs=options.jobs, backend=options.backend, done=done, warn=bar.note)
        bar.close()
        journal.write_tables([trial.key for trial in trials])
        found = journal.results
    results = [found[trial.key] for trial in trials]
    rows = [result.row for result in results]
    heading = f"# Flights\n\n`python -m sim.evaluate {shlex.join(options.words)}`\n"
    text = summary_text(heading, rows, [result.timing for result in results])
    files.write_whole(SettingsError, options.out / "summary.md", text)
    draw_summary(rows, options.out / "summary.png")
    if not options.no_movie:
        _film(trials, results, options.out / "flight.gif")
    print(text)
    return 0 if all(flawless(row) for row in rows) else 1


def _trials(options: argparse.Namespace) -> list[Trial]:
    """The flights asked for, once nothing is wrong with what they share."""
    scenes = checks.integer(SettingsError, "scenes", options.scenes, least=1)
    seed = checks.integer(SettingsError, "seed", options.seed, least=0)
    options.jobs = checks.integer(SettingsError, "jobs", options.jobs, least=1)
    find_planner(options.planner).check(options.paths)
    checks.choice(SettingsError, "backend", options.backend, known=BACKENDS)
    if options.time_limit is not None:
        checks.number(SettingsError, "time-limit", options.time_limit, above=0.0)
    margin_m = checks.number(SettingsError, "tracking-margin", options.tracking_margin, least=0.0)
    first = Trial(
        options.family, options.drones, options.tasks, seed, options.planner, options.time_limit, flight_settings(options),
        options.force, margin_m, options.paths, event_settings(options),
    )  # fmt: skip
    first.scene()  # a family or a size that cannot be is refused before anything runs
    load_pybullet()
    return [replace(first, seed=seed + offset) for offset in range(scenes)]


def _film(trials: list[Trial], results: list[Result], path: Path) -> None:
    """The first flight that was made, flown again for its movie."""
    for trial, result in zip(trials, results, strict=True):
        if result.row["contacts"] is not None:
            scene = trial.scene()
            made = trial.plan(scene)
            save_movie(replace(trial, force=True).fly(scene, made, trial.happenings(scene, made)).flight, path)
            return


if __name__ == "__main__":
    raise SystemExit(main())
