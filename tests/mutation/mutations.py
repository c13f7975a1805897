"""Ways to break a valid plan, each with the clause that must notice.

Every mutation takes (scene, plan, rng) and returns (mutated plan, clause name), or None where the plan gives no
occasion for it. They work on any certified plan, whoever made it. Dips and crossings last `WINDOW_S`, far less
than the time between samples of any checker that samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flockopt.bundles import Bound
from flockopt.certificate import Plan
from flockopt.flights import Curve, Flight, Visit
from flockopt.geometry.bernstein import control_points, largest_norm
from flockopt.geometry.continuous import least_clearance
from flockopt.geometry.distances import surface_normals
from flockopt.scene import Scene

__all__ = ["MUTATIONS", "mutate"]

Mutation = tuple[Plan, str] | None

WINDOW_S = 0.02

#: Powers of s: a C2 step from 0 to 1, and a C2 bump of height 1 at s = 1/2.
STEP = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
BUMP = 64.0 * np.array([0.0, 0.0, 0.0, 1.0, -3.0, 3.0, -1.0])


def mutate(scene: Scene, plan: Plan, rng: np.random.Generator) -> tuple[str, Plan, str]:
    """A random mutation that the plan gives occasion for: its name, the mutated plan, the clause."""
    for index in rng.permutation(len(MUTATIONS)):
        result = MUTATIONS[index](scene, plan, rng)
        if result is not None:
            return MUTATIONS[index].__name__, *result
    raise ValueError("the plan gives no occasion for any mutation")


# -- what mutations are made of -----------------------------------------------------------------------------


def _pick(rng: np.random.Generator, items):
    items = list(items)
    return items[int(rng.integers(len(items)))] if items else None


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _with_flight(plan: Plan, drone: str, flight: Flight) -> Plan:
    """The plan with another flight, whose length and makespan the cost tells truly."""
    flights = plan.flights | {drone: flight}
    length = math.fsum(other.curve.length for other in flights.values())
    makespan = max(other.curve.end_time for other in flights.values())
    return replace(plan, flights=flights, cost=replace(plan.cost, length=length, makespan=makespan))


def _split(curve: Curve, time: float) -> tuple[Curve, int]:
    """The same curve with a breakpoint at ``time``, and the index of the piece that begins there."""
    piece = int(np.searchsorted(curve.breakpoints, time, side="right") - 1)
    if time - curve.breakpoints[piece] < 1e-9:
        return curve, piece
    if curve.breakpoints[piece + 1] - time < 1e-9:
        return curve, piece + 1
    local, old = time - curve.breakpoints[piece], curve.coefficients[piece]
    num_terms = old.shape[1]
    late = np.array(
        [
            [sum(math.comb(n, m) * axis[n] * local ** (n - m) for n in range(m, num_terms)) for m in range(num_terms)]
            for axis in old
        ]
    )
    breakpoints = np.insert(curve.breakpoints, piece + 1, time)
    return Curve(breakpoints, np.insert(curve.coefficients, piece + 1, late, axis=0)), piece + 1


def _add(curve: Curve, piece: int, shape: np.ndarray, offset: np.ndarray) -> Curve:
    """Add ``offset`` (3,) m times a polynomial of the piece's own progress in [0, 1]."""
    terms = np.zeros((*curve.coefficients.shape[:2], max(curve.coefficients.shape[2], len(shape))))
    terms[:, :, : curve.coefficients.shape[2]] = curve.coefficients
    span = curve.breakpoints[piece + 1] - curve.breakpoints[piece]
    terms[piece, :, : len(shape)] += offset[:, None] * shape / span ** np.arange(len(shape))
    return Curve(curve.breakpoints, terms)


def _moment(curve: Curve, rng: np.random.Generator) -> float | None:
    """A time with room for a window around it."""
    low, high = curve.start_time + WINDOW_S, curve.end_time - WINDOW_S
    return float(rng.uniform(low, high)) if low < high else None


def _dent(curve: Curve, time: float, offset: np.ndarray) -> Curve:
    """Push the curve by ``offset`` (3,) m at ``time``, smoothly, within `WINDOW_S`."""
    time = min(max(time, curve.start_time + WINDOW_S / 2), curve.end_time - WINDOW_S / 2)
    curve, first = _split(curve, time - WINDOW_S / 2)
    curve, last = _split(curve, time + WINDOW_S / 2)
    middle = int(np.searchsorted(curve.breakpoints, time, side="right") - 1)
    if last - first == 1:
        return _add(curve, first, BUMP, offset)
    # a breakpoint lies within the window: up on the piece before the one nearest the middle, down on the one after
    middle = min(max(middle, first + 1), last - 1)
    return _add(_add(curve, middle - 1, STEP, offset), middle, np.eye(6)[0] - STEP, offset)


def _dented(plan: Plan, drone: str, time: float, offset: np.ndarray) -> Plan:
    flight = plan.flights[drone]
    return _with_flight(plan, drone, Flight(_dent(flight.curve, time, offset), flight.visits))


def _index(scene: Scene, drone: str) -> int:
    return [other.id for other in scene.drones].index(drone)


# -- coverage and capacity ----------------------------------------------------------------------------------


def swap_order(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """Two neighbours in a route change places; the flight stays."""
    drone = _pick(rng, (name for name, route in plan.routes.items() if len(route) > 1))
    if drone is None:
        return None
    route = list(plan.routes[drone])
    rank = int(rng.integers(len(route) - 1))
    route[rank], route[rank + 1] = route[rank + 1], route[rank]
    return replace(plan, routes=plan.routes | {drone: tuple(route)}), "coverage"


def swap_visits(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """Two neighbours change places in the route and among the visits, which then go back in time."""
    names = (name for name, flight in plan.flights.items() if len(flight.visits) > 1)
    drone = _pick(rng, names)
    if drone is None:
        return None
    flight, route = plan.flights[drone], list(plan.routes[drone])
    visits, rank = list(flight.visits), int(rng.integers(len(route) - 1))
    visits[rank], visits[rank + 1] = visits[rank + 1], visits[rank]
    route[rank], route[rank + 1] = route[rank + 1], route[rank]
    mutated = _with_flight(plan, drone, Flight(flight.curve, tuple(visits)))
    return replace(mutated, routes=plan.routes | {drone: tuple(route)}), "coverage"


def drop_task(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A task is left out of its route and of the visits."""
    drone = _pick(rng, (name for name, route in plan.routes.items() if route))
    if drone is None:
        return None
    flight, task = plan.flights[drone], _pick(rng, plan.routes[drone])
    visits = tuple(visit for visit in flight.visits if visit.task != task)
    route = tuple(other for other in plan.routes[drone] if other != task)
    return replace(_with_flight(plan, drone, Flight(flight.curve, visits)), routes=plan.routes | {drone: route}), "coverage"


def serve_twice(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A drone claims to serve its last task once more."""
    drone = _pick(rng, (name for name, route in plan.routes.items() if route))
    if drone is None:
        return None
    flight = plan.flights[drone]
    last = flight.visits[-1]
    again = Visit(last.task, last.time + scene.tasks[[task.id for task in scene.tasks].index(last.task)].service_time)
    mutated = _with_flight(plan, drone, Flight(flight.curve, (*flight.visits, again)))
    return replace(mutated, routes=plan.routes | {drone: (*plan.routes[drone], last.task)}), "coverage"


def forget_flight(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A drone with tasks has no trajectory."""
    drone = _pick(rng, (name for name in plan.flights if plan.routes.get(name)))
    if drone is None:
        return None
    return replace(plan, flights={name: flight for name, flight in plan.flights.items() if name != drone}), "coverage"


def overload(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A drone takes over every task of the fleet."""
    demand = sum(task.demand for task in scene.tasks)
    drone = _pick(rng, (drone.id for drone in scene.drones if drone.capacity < demand))
    if drone is None:
        return None
    return replace(plan, routes={drone: tuple(task.id for task in scene.tasks)}), "capacity"


# -- the flight itself --------------------------------------------------------------------------------------


def move_anchor(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """The flight passes a task 2 mm off, as smoothly as before."""
    drone = _pick(rng, (name for name, flight in plan.flights.items() if flight.visits))
    if drone is None:
        return None
    flight = plan.flights[drone]
    visit, offset = _pick(rng, flight.visits), 2e-3 * _direction(rng)
    if not flight.curve.start_time < visit.time <= flight.curve.end_time + 1e-9:
        return None
    task = next(task for task in scene.tasks if task.id == visit.task)
    offset += np.array(task.position) - flight.curve(visit.time)
    curve, after = _split(flight.curve, min(visit.time, flight.curve.end_time))
    curve = _add(curve, after - 1, STEP, offset)
    if after < curve.num_pieces:
        curve = _add(curve, after, np.eye(6)[0] - STEP, offset)
    return _with_flight(plan, drone, Flight(curve, flight.visits)), "visits"


def mistime_visit(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A visit is said to be when the drone is elsewhere."""
    drone = _pick(rng, (name for name, flight in plan.flights.items() if flight.visits))
    if drone is None:
        return None
    flight = plan.flights[drone]
    rank = int(rng.integers(len(flight.visits)))
    visit = flight.visits[rank]
    task = next(task for task in scene.tasks if task.id == visit.task)
    for back in np.arange(0.05, visit.time, 0.05):
        if np.linalg.norm(flight.curve(visit.time - back) - np.array(task.position)) > 1.1e-3:
            visits = list(flight.visits)
            visits[rank] = Visit(visit.task, float(visit.time - back))
            return _with_flight(plan, drone, Flight(flight.curve, tuple(visits))), "visits"
    return None


def dip(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A flight dips 2 mm too near to an obstacle for an instant."""
    drone = _pick(rng, plan.flights)
    if drone is None or not scene.obstacles:
        return None
    curve, space = plan.flights[drone].curve, scene.free_space(scene.drones[_index(scene, drone)].radius + scene.clearance)
    _, time, _ = least_clearance(space, curve.breakpoints, curve.coefficients, 1e-6)
    if rng.integers(2):
        time = _moment(curve, rng)
    if time is None or curve.duration < 2 * WINDOW_S:
        return None
    # where the dent is deepest: it may have to keep off the ends, and then off a breakpoint
    dented = _dent(curve, time, np.array([0.0, 0.0, 1.0]))
    times = np.linspace(curve.start_time, curve.end_time, 3)
    times = np.concatenate([dented.breakpoints, (dented.breakpoints[1:] + dented.breakpoints[:-1]) / 2, times])
    deepest = float(times[np.argmax(np.linalg.norm(dented(times) - curve(times), axis=1))])
    gaps = _distances(scene, curve(deepest)) - space.needs
    nearest = int(gaps.argmin())
    inward = -surface_normals(space.table[nearest : nearest + 1], curve(deepest))[0, 0]
    return _dented(plan, drone, time, (gaps[nearest] + 2e-3) * inward), "clearance"


def _distances(scene: Scene, point: np.ndarray) -> np.ndarray:
    from flockopt.geometry.distances import distances

    return distances(scene.obstacle_table, point)[0]


def cross(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A drone darts 1 % too near to another one for an instant."""
    drone = _pick(rng, plan.flights)
    if drone is None or scene.num_drones < 2:
        return None
    curve = plan.flights[drone].curve
    time = _moment(curve, rng)
    if time is None:
        return None
    if curve.num_pieces and np.abs(curve.breakpoints - time).min() < WINDOW_S:
        return None
    other = _pick(rng, (other for other in scene.drones if other.id != drone))
    there = plan.flights[other.id].curve(time) if other.id in plan.flights else np.array(other.start)
    apart = there - curve(time)
    axes = scene.axes_between(_index(scene, drone), _index(scene, other.id))
    norm = float(np.linalg.norm(apart / axes))
    return _dented(plan, drone, time, apart * (1.0 - 0.99 / norm)), "separation"


def wander(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A flight strays from its route for an instant, farther in all than the drone may fly; its route is as long as it was."""
    drone = _pick(rng, (drone for drone in scene.drones if drone.max_distance is not None and drone.id in plan.flights))
    if drone is None:
        return None
    curve = plan.flights[drone.id].curve
    time = _moment(curve, rng)
    if time is None:
        return None
    return _dented(plan, drone.id, time, (drone.max_distance - curve.length + 0.01) * _direction(rng)), "capacity"


def leave_bounds(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A flight leaves the bounds by 2 mm for an instant."""
    drone = _pick(rng, plan.flights)
    if drone is None:
        return None
    curve = plan.flights[drone].curve
    time = _moment(curve, rng)
    if time is None or np.abs(curve.breakpoints - time).min() < WINDOW_S:
        return None
    axis, offset = int(rng.integers(3)), np.zeros(3)
    if rng.integers(2):
        offset[axis] = scene.bounds.upper[axis] + 2e-3 - curve(time)[axis]
    else:
        offset[axis] = scene.bounds.lower[axis] - 2e-3 - curve(time)[axis]
    return _dented(plan, drone, time, offset), "bounds"


def hurry(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A drone flies its path just so much faster that one limit is passed by 1 %."""
    drone = _pick(rng, plan.flights)
    if drone is None:
        return None
    flight, limits = plan.flights[drone], scene.drones[_index(scene, drone)]
    curve = flight.curve
    control = control_points(curve.breakpoints, curve.coefficients, curve.coefficients.shape[2])
    bounds = (limits.max_speed, limits.max_acceleration, limits.max_jerk)
    ratios = [largest_norm(curve.breakpoints, control, order)[0] / limit for order, limit in enumerate(bounds, start=1)]
    factor = max((ratio / 1.01) ** (1 / order) for order, ratio in enumerate(ratios, start=1))
    visits = tuple(Visit(visit.task, visit.time * factor) for visit in flight.visits)
    return _with_flight(plan, drone, Flight(curve.stretched(factor), visits)), "limits"


def jump(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """Position jumps by 10 µm, velocity by 1 mm/s, or acceleration by 0.1 m/s² at a breakpoint."""
    drone = _pick(rng, plan.flights)
    if drone is None:
        return None
    flight = plan.flights[drone]
    time = _moment(flight.curve, rng)
    if time is None:
        return None
    curve, piece = _split(flight.curve, time)
    span = curve.breakpoints[piece + 1] - curve.breakpoints[piece]
    order = int(rng.integers(3))
    # s**order (1 - s)**3, whose derivatives beyond the order jump as well, and all of them are at rest at s = 1
    shape = np.polynomial.polynomial.polymul(np.eye(order + 1)[order], [1.0, -3.0, 3.0, -1.0])
    size = (1e-5, 1e-3 * span, 0.05 * span**2)[order]
    return _with_flight(plan, drone, Flight(_add(curve, piece, shape, size * _direction(rng)), flight.visits)), "continuity"


def wrong_start(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A flight begins 10 µm off its start."""
    drone = _pick(rng, plan.flights)
    if drone is None:
        return None
    flight = plan.flights[drone]
    curve = _add(flight.curve, 0, np.eye(6)[0] - STEP, 1e-5 * _direction(rng))
    return _with_flight(plan, drone, Flight(curve, flight.visits)), "start"


def never_rest(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """A flight ends at 1 mm/s."""
    drone = _pick(rng, plan.flights)
    if drone is None:
        return None
    flight = plan.flights[drone]
    last = flight.curve.num_pieces - 1
    span = flight.curve.breakpoints[-1] - flight.curve.breakpoints[-2]
    shape = np.array([0.0, 0.0, 0.0, -1.0, 1.0])  # s**3 (s - 1)
    curve = _add(flight.curve, last, shape, 1e-3 * span * _direction(rng))
    return _with_flight(plan, drone, Flight(curve, flight.visits)), "start"


# -- claims -------------------------------------------------------------------------------------------------


def wrong_bound(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """The lower bound is claimed 0.1 % higher, with the gap that goes with it; or claimed without any proof."""
    cost = plan.cost
    value = cost.travel if cost.lower_bound is None else cost.lower_bound * 1.001 + 1e-3
    gap = (cost.travel - value) / value if value else None
    return replace(plan, cost=replace(cost, lower_bound=value, gap=gap)), "bound"


def wrong_cost(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """One cost is told 0.01 % too low."""
    names = [name for name in ("length", "travel", "lower_bound", "makespan") if (getattr(plan.cost, name) or 0.0) > 0.1]
    name = _pick(rng, names)
    if name is None:
        return None
    return replace(plan, cost=replace(plan.cost, **{name: getattr(plan.cost, name) * (1 - 1e-4)})), "bound"


def wrong_gap(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """The gap is told smaller than it is, or told without a bound."""
    gap = plan.cost.gap
    return replace(plan, cost=replace(plan.cost, gap=0.0 if gap is None else gap - 1e-3)), "bound"


def wrong_proof(scene: Scene, plan: Plan, rng: np.random.Generator) -> Mutation:
    """The proof's vector has an entry too many, or one that is absurd."""
    proof = plan.certificate.bound if plan.certificate is not None else None
    if proof is None or plan.cost.lower_bound is None or not scene.tasks:
        return None
    dual = np.append(proof.dual, 0.0)
    if proof.kind in ("two-ended-forest", "ng-route-any-end", "held-karp-forest") and rng.integers(2):
        dual = np.array(proof.dual)
        dual[int(rng.integers(scene.num_tasks))] += 10.0 ** rng.integers(4, 12)
    certificate = replace(plan.certificate, bound=Bound(proof.kind, proof.value, dual))
    return replace(plan, certificate=certificate), "bound"


MUTATIONS: tuple[Callable[[Scene, Plan, np.random.Generator], Mutation], ...] = (
    swap_order, swap_visits, drop_task, serve_twice, forget_flight, overload,
    move_anchor, mistime_visit, dip, cross, wander, leave_bounds, hurry, jump, wrong_start, never_rest,
    wrong_bound, wrong_cost, wrong_gap, wrong_proof,
)  # fmt: skip
