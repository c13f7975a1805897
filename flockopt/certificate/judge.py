"""The judge: whether a plan does what its scene asks, at every instant, recomputed from the plan's polynomials.

It trusts nothing a plan says of itself and imports no planner. Each clause reports its margin and where it is
tightest (docs/certificate.md). Numbers are judged with the tolerances below, one per quantity.
"""

from __future__ import annotations

import math

import numpy as np

from flockopt.batches.deadline import NEVER, Deadline
from flockopt.bundles import Bound
from flockopt.certificate.case import JudgedCase, Worst, check_names
from flockopt.certificate.certificate import CLAUSES, FLYABILITY, Certificate, Clause
from flockopt.certificate.clauses import COST_TOLERANCE, JUDGES, _in_space
from flockopt.certificate.engines import ENGINES
from flockopt.certificate.placement import certificate_from, plan_into
from flockopt.certificate.plan_file import Plan
from flockopt.errors import SettingsError
from flockopt.scene import Scene
from flockopt.scene.frame import Frame
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel

__all__ = ["certify"]


#: Curves that reach farther than this, seen from the scene's midst, are not judged any further: rounding would decide.
LARGEST_COORDINATE_M = 1e6

#: Clauses that fail without a closer look where a curve does.
IN_SPACE = ("visits", "limits", "bounds", "clearance", "separation", FLYABILITY)


def certify(
    scene: Scene,
    plan: Plan,
    *,
    travel: Travel | None = None,
    bound: Bound | None = None,
    engine: str = "closed-form",
    rounding: float = 0.0,
    deadline: Deadline = NEVER,
) -> Certificate:
    """Judge a plan.

    Args:
        scene: The scene it is for.
        plan: The plan; its status, cost and certificate are only claims.
        travel: The scene's travel, if it is at hand; computed otherwise.
        bound: What proves the plan's lower bound, where its certificate does not hold that yet.
        engine: What finds the least clearance and separation: ``"closed-form"``, or ``"fcl"`` for python-fcl's distances.
        rounding: How far each coefficient may be off, where it is known to only so many decimals: what that moves states by, at
            the ends of pieces, is let pass by the clauses ``start`` and ``continuity``.
        deadline: When to give up.

    Raises:
        PlanError: If the plan is for another scene, or names a drone or a task that the scene does not have.
        SettingsError: If there is no such engine.
        MissingExtra: If python-fcl is asked for and not installed.
        OutOfTime: If the deadline passes.
    """
    if engine not in ENGINES:
        raise SettingsError("engine", f"is {engine!r}", f"must be one of {', '.join(ENGINES)}", "choose one")
    check_names(scene, plan)
    proof = bound if bound is not None else plan.certificate.bound if plan.certificate is not None else None
    frame = Frame.of(scene.bounds)
    scene, plan = frame.near(scene), plan_into(frame, plan)
    case = JudgedCase(scene, plan, travel or _travel(scene, plan, deadline), proof, deadline, rounding)
    judges = JUDGES | _in_space(engine)
    names = CLAUSES if not any(drone.has_abilities for drone in scene.drones) else (*CLAUSES, FLYABILITY)
    with np.errstate(over="ignore", invalid="ignore"):  # a hostile plan's overflows fail the clauses they are in
        wild = _wild_drone(case)
        clauses = (judges[name](case) if wild is None or name not in IN_SPACE else _wild(name, wild) for name in names)
        return certificate_from(frame, Certificate(tuple(clauses), proof))


def _travel(scene: Scene, plan: Plan, deadline: Deadline) -> Travel:
    """The travel that a plan is costed by: where no bound is claimed, its routes' legs alone if they account for its cost."""
    if plan.cost.lower_bound is None and scene.num_tasks:
        number = {task.id: index for index, task in enumerate(scene.tasks)}
        routes = [[number[task] for task in plan.routes.get(drone.id, ())] for drone in scene.drones]
        legs = compute_travel(scene, routes=routes, deadline=deadline)
        if abs(legs.total(routes) - plan.cost.travel) <= COST_TOLERANCE * max(plan.cost.travel, 1.0):
            return legs
    return compute_travel(scene, deadline=deadline)


def _wild_drone(case: JudgedCase) -> str | None:
    """A drone whose curve reaches beyond all measure."""
    for drone, control in zip(case.scene.drones, case.controls, strict=True):
        if not np.abs(control).max() <= LARGEST_COORDINATE_M:
            return drone.id
    return None


def _wild(name: str, drone: str) -> Clause:
    worst = Worst()
    worst.see(-math.inf, drone=drone, detail=f"drone {drone} reaches beyond {LARGEST_COORDINATE_M:g} m")
    return worst.clause(name, "m")
