"""The clauses of a certificate, one function each, and their tolerances."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from flockopt.certificate.case import JudgedCase, Worst, to_point
from flockopt.certificate.certificate import FLYABILITY, Clause
from flockopt.certificate.engines import ENGINES
from flockopt.certificate.flyability import judge_flyability
from flockopt.certificate.proof import recompute_bound
from flockopt.errors import PlanError
from flockopt.flights import Curve
from flockopt.geometry.bernstein import largest_norm, least_margin
from flockopt.geometry.continuous import farthest_from
from flockopt.records.arrays import FloatArray
from flockopt.scene import Drone
from flockopt.travel.travel import REVISION

__all__ = ["CLEARANCE_TOLERANCE_M", "COST_TOLERANCE", "JUDGES", "LIMIT_TOLERANCE", "SEPARATION_TOLERANCE_M"]

#: A drone is at a task, or at its end, within this.
VISIT_TOLERANCE_M = 1e-3

#: What rounding may add to distances on files' decimal numbers.
ROUNDING_M = 1e-9

#: Jumps from piece to piece, and from the start state or from rest.
POSITION_TOLERANCE_M = 1e-6
VELOCITY_TOLERANCE_MPS = 1e-4

ACCELERATION_TOLERANCE_MPS2 = 1e-2
STATE_TOLERANCES = np.array([POSITION_TOLERANCE_M, VELOCITY_TOLERANCE_MPS, ACCELERATION_TOLERANCE_MPS2])

#: Visits may be this much out of order, and a drone that flies at the start may start this late.
TIME_TOLERANCE_S = 1e-9

#: Speed, acceleration, jerk and distance may pass their limits by this fraction.
LIMIT_TOLERANCE = 1e-6

#: Bounds, clearance and separation may be undercut by this much.
BOUNDS_TOLERANCE_M = 1e-6
CLEARANCE_TOLERANCE_M = 1e-6
SEPARATION_TOLERANCE_M = 1e-6

#: Costs may differ from what is recomputed by this fraction, or by this much where they are smaller than one.
COST_TOLERANCE = 1e-6
#: The same where ways were found by another revision of travel; what is measured on flights alone is not.
REVISION_TOLERANCE, FLOWN = 0.02, ("cost.length", "cost.makespan")

LIMITS = (("speed", "max_speed", "m/s"), ("acceleration", "max_acceleration", "m/s²"), ("jerk", "max_jerk", "m/s³"))


def _coverage(case: JudgedCase) -> Clause:
    faults = list(_coverage_faults(case))
    task, drone, detail = faults[0] if faults else (None, None, "")
    return Clause("coverage", not faults, float(-len(faults)), "tasks", task=task, drone=drone, detail=detail)


def _coverage_faults(case: JudgedCase) -> Iterator[tuple[str | None, str | None, str]]:
    """(task, drone, what is wrong) of every breach."""
    served = Counter(task for route in case.plan.routes.values() for task in route)
    for task in case.scene.tasks:
        if served[task.id] != 1:
            yield task.id, None, f"task {task.id} is served {served[task.id]} times, not once"
        elif task.id in case.plan.unserved:
            yield task.id, None, f"task {task.id} is in a route and among the unserved"
    service = {task.id: task.service_time for task in case.scene.tasks}
    for drone in case.scene.drones:
        flight = case.plan.flights.get(drone.id)
        route, visits = case.plan.routes.get(drone.id, ()), flight.visits if flight is not None else ()
        flown = tuple(visit.task for visit in visits)
        if flown != route:
            odd = next((task for task, other in zip(route, flown, strict=False) if task != other), None)
            words = f"visits {', '.join(flown) or 'nothing'}; its route is {', '.join(route) or 'empty'}"
            yield odd, drone.id, f"drone {drone.id} {words}"
        for early, late in pairwise(visits):
            if not late.time >= early.time + service[early.task] - TIME_TOLERANCE_S:
                yield late.task, drone.id, f"drone {drone.id} is at {late.task} before it has done with {early.task}"


def _capacity(case: JudgedCase) -> Clause:
    worst = Worst()
    for i, (drone, route) in enumerate(zip(case.scene.drones, case.routes, strict=True)):
        load = float(case.scene.demands[route].sum())
        detail = f"drone {drone.id} serves a demand of {load:g}; its capacity is {drone.capacity}"
        worst.see((drone.capacity - load) / max(drone.capacity, 1), drone=drone.id, detail=detail)
        if drone.max_distance is not None:
            length = case.travel.route_length(i, route)
            detail = f"drone {drone.id} travels {length:g} m; its max_distance is {drone.max_distance:g} m"
            worst.see(1.0 - length / drone.max_distance + LIMIT_TOLERANCE, drone=drone.id, detail=detail)
            flown = case.plan.flights[drone.id].curve.length if drone.id in case.plan.flights else 0.0
            detail = f"drone {drone.id} flies {flown:g} m; its max_distance is {drone.max_distance:g} m"
            worst.see(1.0 - flown / drone.max_distance + LIMIT_TOLERANCE, drone=drone.id, detail=detail)
    return worst.clause("capacity", "fraction")


def _start(case: JudgedCase) -> Clause:
    worst = Worst()
    for i, drone in enumerate(case.scene.drones):
        flight = case.plan.flights.get(drone.id)
        if flight is None:
            _start_parked(worst, drone)
        else:
            firsts, lasts = case.states[i]
            tolerances = STATE_TOLERANCES + case.blur(i)[[0, -1]]
            _start_flying(worst, drone, flight.curve, firsts[0], lasts[-1], tolerances)
    return worst.clause("start", "fraction")


def _start_parked(worst: Worst, drone: Drone) -> None:
    moving = max(
        math.hypot(*drone.velocity) / VELOCITY_TOLERANCE_MPS, math.hypot(*drone.acceleration) / ACCELERATION_TOLERANCE_MPS2
    )
    worst.see(1.0 - moving, drone=drone.id, time=0.0, detail=f"drone {drone.id} starts in motion and has no trajectory")
    if drone.end_point is not None:
        away = math.dist(drone.start, drone.end_point)
        detail = f"drone {drone.id} has no trajectory and its end is {away:g} m from its start"
        worst.see(1.0 - away / VISIT_TOLERANCE_M, drone=drone.id, time=0.0, detail=detail)


def _start_flying(
    worst: Worst, drone: Drone, curve: Curve, first: FloatArray, last: FloatArray, tolerances: FloatArray
) -> None:
    """Its first and last position, velocity and acceleration, (3, 3) each, and how far each may be off, (2, 3)."""
    wanted = (drone.start, drone.velocity, drone.acceleration)
    names = ("position", "velocity", "acceleration")
    for name, seen, due, tolerance in zip(names, first, wanted, tolerances[0], strict=True):
        away = math.dist(seen, due)
        margin = 1.0 - away / tolerance
        if not worst.lets(margin):
            detail = f"drone {drone.id} begins with its {name} {away:g} off its start state"
            worst.see(margin, drone=drone.id, time=curve.start_time, place=to_point(first[0]), detail=detail)
    if curve.start_time > TIME_TOLERANCE_S and any((*drone.velocity, *drone.acceleration)):
        detail = f"drone {drone.id} starts in motion, so its trajectory must begin at t = 0"
        worst.see(-1.0, drone=drone.id, time=curve.start_time, detail=detail)
    for name, seen, tolerance in zip(names[1:], last[1:], tolerances[1, 1:], strict=True):
        away = math.hypot(*seen)
        margin = 1.0 - away / tolerance
        if not worst.lets(margin):
            detail = f"drone {drone.id} ends with {name} {away:g}, not at rest"
            worst.see(margin, drone=drone.id, time=curve.end_time, place=to_point(last[0]), detail=detail)
    if drone.end_point is not None:
        away = math.dist(last[0], drone.end_point)
        detail = f"drone {drone.id} ends {away:g} m from its end"
        worst.see(1.0 - away / VISIT_TOLERANCE_M, drone=drone.id, time=curve.end_time, place=to_point(last[0]), detail=detail)


def _visits(case: JudgedCase) -> Clause:
    worst = Worst()
    tasks = {task.id: task for task in case.scene.tasks}
    for i, drone in enumerate(case.scene.drones):
        case.check_time()
        flight = case.plan.flights.get(drone.id)
        for visit in flight.visits if flight is not None else ():
            task = tasks[visit.task]
            until = visit.time + task.service_time
            away, time = farthest_from(*case.curves[i], np.array(task.position), visit.time, until)
            margin = VISIT_TOLERANCE_M - away
            if not worst.lets(margin):
                detail = f"drone {drone.id} is {away:g} m from task {task.id}, which it should be at"
                worst.see(margin, drone=drone.id, task=task.id, time=time, place=case.place(i, time), detail=detail)
    return worst.clause("visits", "m", ROUNDING_M)


def _continuity(case: JudgedCase) -> Clause:
    worst = Worst()
    for i, (drone, (times, _), (firsts, lasts)) in enumerate(zip(case.scene.drones, case.curves, case.states, strict=True)):
        tolerances = STATE_TOLERANCES + 2.0 * case.blur(i)[:-1]  # (K - 1, 3)
        gap = firsts[1:] - lasts[:-1]  # (K - 1, 3, 3)
        jumps = np.sqrt((gap * gap).sum(axis=2)) / tolerances  # (K - 1, 3) in tolerances
        if jumps.size:
            piece, order = divmod(int(jumps.argmax()), 3)  # of the first that is not a number, if there is one
            if worst.lets(1.0 - float(jumps[piece, order])):
                continue
            quantity = ("position", "velocity", "acceleration")[order]
            size = jumps[piece, order] * tolerances[piece, order]
            detail = f"the {quantity} of drone {drone.id} jumps by {size:g} at breakpoint {piece + 1}"
            time, place = float(times[piece + 1]), to_point(lasts[piece, 0])
            worst.see(1.0 - float(jumps[piece, order]), drone=drone.id, time=time, place=place, detail=detail)
    return worst.clause("continuity", "fraction")


def _limits(case: JudgedCase) -> Clause:
    worst = Worst()
    for i, drone in enumerate(case.scene.drones):
        if drone.id not in case.plan.flights:
            continue
        case.check_time()
        for order, (quantity, field, unit) in enumerate(LIMITS, start=1):
            value, time = largest_norm(case.curves[i][0], case.controls[i], order)
            limit = getattr(drone, field)
            margin = 1.0 - value / limit
            if not worst.lets(margin):
                detail = f"drone {drone.id} has {quantity} {value:.6g} {unit}; its {field} is {limit:g}"
                worst.see(margin, drone=drone.id, time=time, place=case.place(i, time), detail=detail)
    return worst.clause("limits", "fraction", LIMIT_TOLERANCE)


def _bounds(case: JudgedCase) -> Clause:
    worst = Worst()
    lower, upper = np.array(case.scene.bounds.lower), np.array(case.scene.bounds.upper)
    for i, drone in enumerate(case.scene.drones):
        margin, time, axis = least_margin(case.curves[i][0], case.controls[i], lower, upper)
        if not worst.lets(margin):
            detail = f"drone {drone.id} is {-margin:g} m outside the bounds in {'xyz'[axis]}"
            worst.see(margin, drone=drone.id, time=time, place=case.place(i, time), detail=detail)
    return worst.clause("bounds", "m", BOUNDS_TOLERANCE_M)


def _in_space(engine: str) -> dict[str, Callable[[JudgedCase], Clause]]:
    """The judges of clearance and separation that ask this engine."""

    def clearance(case: JudgedCase) -> Clause:
        worst, nearest = Worst(), ENGINES[engine].clearance(case)
        if nearest is not None:
            drone, obstacle = case.scene.drones[nearest.drone].id, case.scene.obstacles[nearest.other].id
            detail = f"drone {drone} is {-nearest.margin:g} m nearer to obstacle {obstacle} than radius + clearance"
            worst.see(nearest.margin, drone=drone, obstacle=obstacle, time=nearest.time, place=nearest.place, detail=detail)
        return worst.clause("clearance", "m", CLEARANCE_TOLERANCE_M)

    def separation(case: JudgedCase) -> Clause:
        worst, nearest = Worst(), ENGINES[engine].separation(case)
        if nearest is not None:
            one, other = case.scene.drones[nearest.drone].id, case.scene.drones[nearest.other].id
            detail = f"drones {one} and {other} are {-nearest.margin:g} m nearer to each other than they may be"
            worst.see(nearest.margin, drone=one, other_drone=other, time=nearest.time, place=nearest.place, detail=detail)
        return worst.clause("separation", "m", SEPARATION_TOLERANCE_M)

    return {"clearance": clearance, "separation": separation}


def _bound(case: JudgedCase) -> Clause:
    worst = Worst()
    try:
        proven = _proven(case)
    except PlanError as fault:
        worst.see(-math.inf, detail=str(fault))
    else:
        is_other = case.plan.cost.travel_revision != REVISION
        for name, claimed, actual in _figures(case, proven):
            allowed = REVISION_TOLERANCE if is_other and name not in FLOWN else COST_TOLERANCE
            worst.see(allowed - _error(claimed, actual), detail=f"{name} is {claimed}; recomputed it is {actual}")
    notes = [] if case.plan.cost.lower_bound is not None else ["no bound is claimed"]
    if case.plan.cost.travel_revision != REVISION and case.scene.obstacles:
        notes.append(f"its travel is of revision {case.plan.cost.travel_revision}: compared within {REVISION_TOLERANCE:.0%}")
    return worst.clause("bound", "fraction", note="; ".join(notes))


def _proven(case: JudgedCase) -> float | None:
    """The lower bound that the plan's proof proves, None where no bound is claimed."""
    if case.plan.cost.lower_bound is None:
        return None
    if case.proof is None:
        raise PlanError("certificate.bound", "is missing", "a lower bound needs its proof", "add it or claim no bound")
    try:
        return recompute_bound(case.scene, case.travel, case.proof)
    except PlanError as fault:
        raise fault.within("certificate.bound") from None


def _figures(case: JudgedCase, proven: float | None) -> Iterator[tuple[str, float | None, float | None]]:
    """(name, claimed, recomputed) of every cost."""
    cost, travel = case.plan.cost, case.travel.total(case.routes)
    gap = None
    if proven is not None and proven > COST_TOLERANCE:
        gap = (travel - proven) / proven
    elif proven is not None and travel <= COST_TOLERANCE:
        gap = 0.0  # nothing to travel, and that is proven
    yield "cost.length", cost.length, math.fsum(flight.curve.length for _, flight in case.flights)
    yield "cost.travel", cost.travel, travel
    yield "cost.makespan", cost.makespan, case.makespan
    yield "cost.lower_bound", cost.lower_bound, proven
    yield "cost.gap", cost.gap, gap
    if proven is not None and case.proof is not None:
        yield "certificate.bound.value", case.proof.value, proven


def _error(claimed: float | None, actual: float | None) -> float:
    """Relative difference; infinite where one of the two is missing or not finite."""
    if claimed is None and actual is None:
        return 0.0
    if claimed is None or actual is None or not math.isfinite(actual):
        return math.inf
    return abs(claimed - actual) / max(abs(actual), 1.0)


JUDGES: dict[str, Callable[[JudgedCase], Clause]] = {
    "coverage": _coverage,
    "capacity": _capacity,
    "start": _start,
    "visits": _visits,
    "continuity": _continuity,
    "limits": _limits,
    "bounds": _bounds,
    "bound": _bound,
    FLYABILITY: lambda case: judge_flyability(case, LIMIT_TOLERANCE),
}
