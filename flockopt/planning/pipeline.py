"""From a scene to a certified plan: propose bundles, make flights of them, keep them apart, judge the result.

Planners only propose; one pipeline finishes every proposal and `flockopt.certify` judges it. Other packages add
planners through the entry-point group ``flockopt.planners`` (docs/adding-a-planner.md).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from flockopt.bundles.bounds.bounds import BOUNDS
from flockopt.certificate import Plan
from flockopt.errors import SettingsError
from flockopt.flights.smoothing.casadi_program import load_casadi
from flockopt.planning.finish import Progress, _Clock, _finish
from flockopt.planning.planners import ANY_ANGLE, Request, default_planner, find_planner
from flockopt.records import checks
from flockopt.scene import Scene
from flockopt.travel.compute import compute_travel

__all__ = ["plan"]

#: Share of what is left of a time limit that the allocation may use; the rest is for flights and the judge.
ALLOCATION_SHARE = 0.7

#: What the allocation has at least, seconds, when a time limit is all but used up.
LEAST_ALLOCATION_S = 1e-3


def plan(
    scene: Scene,
    *,
    planner: str | None = None,
    time_limit_s: float | None = None,
    seed: int = 0,
    bound: str = "tight",
    smoothing: bool = False,
    tracking_margin_m: float = 0.0,
    paths: str = ANY_ANGLE,
    progress: Progress | None = None,
) -> Plan:
    """Plan a fleet's flight and certify it.

    Args:
        scene: The scene.
        planner: Who proposes: see `planner_names`; None for `default_planner`.
        time_limit_s: Seconds for the whole plan; None lets the planner stop by its own measure, which makes the
            answer the same on every machine.
        seed: For everything random.
        bound: How hard to prove a lower bound: see `flockopt.bundles.bounds.bounds.lower_bound`.
        smoothing: Whether to smooth the flights before they are kept apart: the fleet is done earlier, with less jerk,
            for tens of milliseconds a drone (`flockopt.flights.smoothing.smooth`).
        tracking_margin_m: How far drones may stray from the plan, metres: flights keep that much more clearance, and twice
            that much more separation, as far as the scene leaves the room (`flockopt.planning.margins`). The
            certificate is for the scene as it is.
        paths: What drones fly along: ``any-angle``, the shortest paths, or others that the planner knows.
        progress: Called with a stage's name and the fraction of the whole that is done.

    Returns:
        A plan whose status is ``certified`` if every clause of its certificate holds, ``uncertified`` if the
        certificate names clauses that fail, or ``infeasible`` with the reason and without flights.

    Raises:
        SettingsError: On an unknown planner or bound, paths that the planner does not know, a time limit that is not
            positive, or a negative seed or margin.
        MissingExtra: If smoothing is asked for and CasADi is not installed.
    """
    planner = default_planner() if planner is None else planner
    propose = find_planner(planner, paths)
    _check_settings(time_limit_s, seed, bound)
    margin_m = checks.number(SettingsError, "tracking_margin_m", tracking_margin_m, least=0.0)
    if smoothing:
        load_casadi()
    clock = _Clock(progress)
    with clock.stage("travel", 0.0):
        travel = compute_travel(scene)
    with clock.stage("allocate", 0.1):
        left = None if time_limit_s is None else max(ALLOCATION_SHARE * (time_limit_s - clock.total), LEAST_ALLOCATION_S)
        request = Request(scene, travel, left, seed, paths, margin_m)
        proposal = propose(request)
    clock.seconds.update({"generate": 0.0, **proposal.timing})
    finish = partial(_finish, request, planner, bound=bound, smoothing=smoothing, margin_m=margin_m)
    result = finish(proposal, clock)
    if result.status != "certified" and proposal.otherwise is not None:
        with clock.stage("fallback", 0.95):
            other = finish(proposal.otherwise(request), _Clock(None))
        result = other if other.status == "certified" else result
    return replace(result, timing=clock.timing())


def _check_settings(time_limit_s: float | None, seed: int, bound: str) -> None:
    if time_limit_s is not None and not (0.0 < time_limit_s < np.inf):
        raise SettingsError("time_limit_s", f"is {time_limit_s!r}", "must be seconds > 0 or None", "give it some time")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise SettingsError("seed", f"is {seed!r}", "must be an integer >= 0", "choose one")
    if bound not in BOUNDS:
        raise SettingsError("bound", f"is {bound!r}", f"must be one of {', '.join(BOUNDS)}", "choose one")
