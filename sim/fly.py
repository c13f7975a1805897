"""Fly one plan and say what came of it.

    python -m sim.fly SCENE PLAN [--events N] [--gui] [--movie FILE.gif]

Exit status 0 if every task was served and nothing touched, 1 if not, 2 on bad input; after events a task that is listed
with the reason why it was not served counts as accounted for.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from flockopt import Plan, Scene
from flockopt.cli.status import run_command
from flockopt.records.status import Status
from sim.evaluate import add_event_options, add_flight_options, event_settings, flight_settings
from sim.mission.events import Event, schedule
from sim.mission.execution import Execution
from sim.mission.mission import Mission, MissionOutcome
from sim.movie import save_movie
from sim.trials.trial import TRACKING_MARGIN_M

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    return run_command("sim.fly", lambda: _fly(options))


def _fly(options: argparse.Namespace) -> int:
    scene, plan = Scene.load(options.scene), Plan.load(options.plan)
    happening = event_settings(options)
    events = () if happening is None else schedule(scene, plan, options.seed, happening)
    with Mission(
        scene, plan, flight_settings(options), seed=options.seed, tracking_margin_m=TRACKING_MARGIN_M, force=options.force,
        gui=options.gui,
    ) as mission:  # fmt: skip
        outcome = mission.fly(events)
    flight = outcome.flight
    if options.movie is not None:
        save_movie(flight, options.movie)
    print("\n".join([*_account(flight), *(_events(events, outcome) if events else [])]))
    is_complete = not outcome.unexplained if events else flight.measures.completion == 1.0
    return 0 if is_complete and not flight.touches else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sim.fly", description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path, help="scene file")
    parser.add_argument("plan", type=Path, help="plan file for that scene")
    parser.add_argument("--gui", action="store_true", help="watch it in PyBullet's window, in real time")
    parser.add_argument("--movie", type=Path, metavar="FILE.gif", help="write it as an animated picture")
    parser.add_argument("--seed", type=int, default=0, help="of what happens and of replanning (default 0)")
    add_flight_options(parser)
    add_event_options(parser)
    return parser


def _account(flight: Execution) -> list[str]:
    measures = flight.measures
    lines = [
        f"completion      {measures.completion:.1%} ({len(measures.served)} of {flight.scene.num_tasks} tasks)",
        f"contacts        {len(flight.touches)}",
        f"least clearance {_metres(measures.min_clearance)}",
        f"least distance  {_metres(measures.min_separation)}",
        f"tracking error  {1e3 * measures.mean_tracking_error:.1f} mm, {1e3 * measures.max_tracking_error:.1f} mm at most",
        f"energy          {flight.energy.sum():.1f} J",
        f"flown           {flight.times[-1]:.1f} s, {flight.real_time_factor:.0f} times faster than real time",
    ]
    lines += [f"missed          {task} by {metres:.3f} m" for task, metres in measures.missed.items()]
    lines += [f"contact         {touch.drone} with {touch.other} at {touch.time:.2f} s" for touch in flight.touches]
    return lines


def _events(events: Sequence[Event], outcome: MissionOutcome) -> list[str]:
    """What happened, and what came of it."""
    certified = sum(answer.plan.status == Status.CERTIFIED for answer in outcome.answers)
    lines = [f"event           {event}" for event in events]
    lines.append(f"answers         {certified} of {len(outcome.answers)} certified, {len(outcome.swapped)} swapped in")
    return lines + [f"not served      {task}: {reason}" for task, reason in outcome.unserved.items()]


def _metres(value: float | None) -> str:
    return "none to keep" if value is None else f"{value:.3f} m"


if __name__ == "__main__":
    raise SystemExit(main())
