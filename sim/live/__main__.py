"""Watch a fleet fly in the browser, give it orders, and see it replan."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flockopt import Changes, Plan, PlanError, Scene, SettingsError, plan, replan
from flockopt.cli.status import run_command
from flockopt.records import checks
from flockopt.records.status import Status
from sim.live.page import Page
from sim.live.serving import load_viser
from sim.live.session import MOST_SPEED, Session
from sim.trials.trial import TRACKING_MARGIN_M

__all__ = ["main"]

PICTURES_PER_S = 30.0

DEFAULT_PORT, MOST_PORT = 8080, 65535

MANUAL = """The scene is planned, the plan is flown in PyBullet as the wall clock goes, and the page is served on this machine
only (127.0.0.1). On the page:

  drag, wheel       turn and zoom the view; thin lines are the ways ahead, thick ones the ways flown
  click a place     adds a task above it, as high as the slider says; or type x, y, z
  withdraw          removes an open task
  take out          ends a drone's flight where it is; the others take over its tasks, as far as their capacity lasts
  gust              blows for two seconds; no plan and no controller knows of it

Every order is answered in flight: the log says how long that took, which bundles came of it, and what the judge says. A new
plan is flown only if it is certified; what it leaves out is listed with the reason. Ctrl-C ends the session.

examples:
  python -m sim.live examples/scenes/rotterdam.json
  python -m sim.live forest.json --speed 2 --spare 5 --port 9000

exit status: 0 after Ctrl-C; 130 after Ctrl-C before the page is up; 2 bad input (one line on stderr says what and how to
mend it)"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = _parser().parse_args(argv)
    return run_command("sim.live", lambda: _live(options))


def _live(options: argparse.Namespace) -> None:
    load_viser()
    if not 0 <= options.port <= MOST_PORT:
        raise SettingsError("port", f"is {options.port}", f"must be within 0 and {MOST_PORT}", "choose one above 1023")
    scene = _with_spare(Scene.load(options.scene), options.spare)
    made = _planned(scene, options)
    with Session(scene, made, seed=options.seed, speed=options.speed, tracking_margin_m=options.tracking_margin) as session:
        _serve(session, options.port)


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m sim.live", description=__doc__, epilog=MANUAL, formatter_class=raw)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene file")
    parser.add_argument(
        "--speed", type=float, default=1.0,
        help=f"seconds flown for each second on the wall, {MOST_SPEED:g} at most (default 1)",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, default=DEFAULT_PORT,
        help=f"the next free one is taken if it is not; 0 takes any (default {DEFAULT_PORT})",
    )  # fmt: skip
    parser.add_argument("--planner", default="classical", help="who plans at first (default classical)")
    parser.add_argument("--seed", type=int, default=0, help="for planning and replanning (default 0)")
    parser.add_argument(
        "--spare", type=int, default=0, metavar="N", help="capacity each drone gets beyond the scene's (default 0)"
    )
    parser.add_argument(
        "--tracking-margin", type=float, default=TRACKING_MARGIN_M, metavar="M",
        help=f"room that plans keep for tracking errors, metres (default {TRACKING_MARGIN_M:g})",
    )  # fmt: skip
    return parser


def _with_spare(scene: Scene, spare: int) -> Scene:
    """The scene with more capacity, so that it takes longer until nobody can serve another task."""
    more = checks.integer(SettingsError, "spare", spare, least=0)
    return scene.replace(drones=tuple(replace(drone, capacity=drone.capacity + more) for drone in scene.drones))


def _planned(scene: Scene, options: argparse.Namespace) -> Plan:
    """The first plan, once replanning is warmed up too, so that the first order is answered as fast as the others."""
    print(f"planning {scene.name}: {scene.num_drones} drones, {scene.num_tasks} tasks", flush=True)
    made = plan(scene, planner=options.planner, seed=options.seed, tracking_margin_m=options.tracking_margin)
    if made.status != Status.CERTIFIED:
        mend = "try another seed, or --tracking-margin 0"
        raise PlanError("plan", f"is {made.status} {made.reason}".rstrip(), "only certified plans are flown", mend)
    replan(scene, made, 0.0, Changes(), seed=options.seed, tracking_margin_m=options.tracking_margin)
    return made


def _serve(session: Session, port: int) -> None:
    """Fly and show until Ctrl-C."""
    page = Page(session, port)
    try:
        print(f"{page.url} shows the flight; Ctrl-C ends it", flush=True)
        last = time.monotonic()
        while True:
            now = time.monotonic()
            session.tick(now - last)
            page.refresh()
            last = now
            time.sleep(max(0.0, now + 1.0 / PICTURES_PER_S - time.monotonic()))
    except KeyboardInterrupt:
        print(f"\nended after {session.view().now_s:.1f} s of flight")
    finally:
        page.close()


if __name__ == "__main__":
    raise SystemExit(main())
