"""Plans and their files, format ``flockopt.plan/1`` (docs/formats.md), read strictly.

What a file says of itself (its status, its cost, its certificate) is a claim; `flockopt.certify` judges it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from flockopt.certificate.certificate import Certificate
from flockopt.errors import PlanError
from flockopt.flights import Curve, Flight, Visit
from flockopt.records import checks, files
from flockopt.records.arrays import FloatArray
from flockopt.records.status import PLAN_STATUSES, Status
from flockopt.travel.travel import REVISION

__all__ = ["LARGEST_DEGREE", "Cost", "Plan"]

FORMAT = "flockopt.plan/1"

#: What a Crazyflie stores.
LARGEST_DEGREE = 7

#: What a cost measures; the revision of travel that a file without one is of.
MEASURES, FIRST_REVISION = ("length", "travel", "lower_bound", "gap", "makespan"), 1

REQUIRED = (
    "format", "scene", "planner", "status", "routes", "unserved", "trajectories", "cost", "certificate", "timing",
)  # fmt: skip


#: A setting in a plan file.
Setting: TypeAlias = str | float | bool | None

#: Costs that are null where no bound is known.
CLAIMS = ("lower_bound", "gap")


@dataclass(frozen=True)
class Cost:
    """What a plan costs, as it claims.

    Attributes:
        length: Metres flown.
        travel: Metres of the routes over the travel matrix.
        lower_bound: Metres, a proven bound on the travel of any feasible allocation; None where none is claimed.
        gap: (travel - lower_bound) / lower_bound; None without a bound or with a bound of 0 under a travel above 0.
        makespan: Seconds until the last drone has finished.
        travel_revision: Which revision of travel the matrix is of (`flockopt.travel.travel.REVISION`).
    """

    length: float
    travel: float
    lower_bound: float | None
    gap: float | None
    makespan: float
    travel_revision: int = REVISION


@dataclass(frozen=True)
class Plan:
    """A fleet's flight.

    Attributes:
        scene_name: Name of the scene it is for.
        scene_sha256: Digest of that scene (`Scene.sha256`).
        planner: Who proposed it.
        status: One of `flockopt.records.status.PLAN_STATUSES`.
        routes: Task ids in visiting order by drone id; a drone left out serves none.
        unserved: Reason by id of every task that no drone serves.
        flights: By drone id, of the drones that move.
        cost: What it costs.
        certificate: What the judge said of it, or None.
        timing: Seconds by stage.
        reason: Why it is infeasible, or why tasks are left over; empty otherwise.
        episode_steps: In how many steps the planner made its allocation; None where all was allocated at once.
        settings: What steered it, by name: plain values (`flockopt.planning.settings.PlanSettings`, and what the planner adds).
    """

    scene_name: str
    scene_sha256: str
    planner: str
    status: Status
    routes: dict[str, tuple[str, ...]]
    unserved: dict[str, str]
    flights: dict[str, Flight]
    cost: Cost
    certificate: Certificate | None = None
    timing: dict[str, float] = field(default_factory=dict)
    reason: str = ""
    episode_steps: int | None = None
    settings: dict[str, Setting] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "status", _status(self.status))
        if self.status == Status.INFEASIBLE and self.flights:
            seen = f"has {len(self.flights)} of them"
            raise PlanError("trajectories", seen, "an infeasible plan has none", "remove them or correct the status")
        for index, flight in enumerate(self.flights.values()):
            if not flight.curve.at_most_degree(LARGEST_DEGREE):
                where = f"trajectories[{index}].coefficients"
                raise PlanError(where, "hold a higher power", f"must be of degree <= {LARGEST_DEGREE}", "lower the degree")

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Read a plan file.

        Raises:
            PlanError: If the file cannot be read or is not a valid ``flockopt.plan/1``.
        """
        return cls.from_dict(files.read_json(PlanError, path))

    def save(self, path: str | Path) -> None:
        """Write a plan file, whole or not at all; reading it gives back every number exactly."""
        files.write_whole(PlanError, path, json.dumps(self.to_dict(), allow_nan=False) + "\n")

    @classmethod
    def from_dict(cls, item: Any) -> Plan:
        """A plan from its JSON object, read strictly."""
        if isinstance(item, dict) and item.get("format", FORMAT) != FORMAT:
            raise PlanError("format", f"is {checks.shown(item['format'])}", f'must be "{FORMAT}"', "convert the file")
        record = checks.keys(PlanError, item, REQUIRED, ("reason", "episode_steps", "settings"))
        name, digest = _nested("scene", record["scene"], _scene)
        certificate = record["certificate"]
        return cls(
            scene_name=name,
            scene_sha256=digest,
            planner=checks.text(PlanError, "planner", record["planner"]),
            status=_status(record["status"]),
            routes=_table("routes", "drone", checks.objects(PlanError, "routes", record["routes"], _route)),
            unserved=_table("unserved", "task", checks.objects(PlanError, "unserved", record["unserved"], _unserved)),
            flights=_table(
                "trajectories", "drone", checks.objects(PlanError, "trajectories", record["trajectories"], _trajectory)
            ),
            cost=_nested("cost", record["cost"], _cost),
            certificate=None if certificate is None else _nested("certificate", certificate, Certificate.from_dict),
            timing=_nested("timing", record["timing"], _timing),
            reason=checks.text(PlanError, "reason", record["reason"]) if "reason" in record else "",
            episode_steps=checks.integer(PlanError, "episode_steps", record["episode_steps"], least=0)
            if "episode_steps" in record
            else None,
            settings=_nested("settings", record["settings"], _settings) if "settings" in record else {},
        )

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of the plan."""
        record = {
            "format": FORMAT,
            "scene": {"name": self.scene_name, "sha256": self.scene_sha256},
            "planner": self.planner,
            "status": self.status,
            "routes": [{"drone": drone, "tasks": list(tasks)} for drone, tasks in self.routes.items()],
            "unserved": [{"task": task, "reason": reason} for task, reason in self.unserved.items()],
            "trajectories": [_trajectory_record(drone, flight) for drone, flight in self.flights.items()],
            "cost": _cost_record(self.cost),
            "certificate": None if self.certificate is None else self.certificate.to_dict(),
            "timing": {stage: float(seconds) for stage, seconds in self.timing.items()},
        }
        steps = {} if self.episode_steps is None else {"episode_steps": self.episode_steps}
        settings = {"settings": dict(self.settings)} if self.settings else {}
        return record | settings | steps | ({"reason": self.reason} if self.reason else {})


def _status(word: Any) -> Status:
    if word not in PLAN_STATUSES:
        rule = f"must be one of {', '.join(PLAN_STATUSES)}"
        raise PlanError("status", f"is {checks.shown(word)}", rule, "correct its spelling")
    return Status(word)


def _plain(value: float | None) -> float | None:
    return None if value is None else float(value)


def _trajectory_record(drone: str, flight: Flight) -> dict[str, Any]:
    return {
        "drone": drone,
        "breakpoints": flight.curve.breakpoints.tolist(),
        "coefficients": flight.curve.coefficients.tolist(),
        "visits": [{"task": visit.task, "time": float(visit.time)} for visit in flight.visits],
    }


def _nested(field: str, item: Any, build: Any) -> Any:
    try:
        return build(item)
    except PlanError as fault:
        raise fault.within(field) from None


def _table(field: str, key: str, pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """The pairs as a table; an id that stands twice is an error."""
    first: dict[str, int] = {}
    for index, (name, _) in enumerate(pairs):
        if name in first:
            seen = f"is {checks.shown(name)}, the same as {field}[{first[name]}].{key}"
            raise PlanError(f"{field}[{index}].{key}", seen, f"each {key} stands there once", "remove one of the two")
        first[name] = index
    return dict(pairs)


def _scene(item: Any) -> tuple[str, str]:
    record = checks.keys(PlanError, item, ("name", "sha256"))
    digest = checks.text(PlanError, "sha256", record["sha256"])
    if len(digest) != 64 or set(digest) - set("0123456789abcdef"):
        raise PlanError("sha256", f"is {checks.shown(digest)}", "must be 64 hexadecimal digits", "copy it from the scene")
    return checks.text(PlanError, "name", record["name"]), digest


def _route(item: Any) -> tuple[str, tuple[str, ...]]:
    record = checks.keys(PlanError, item, ("drone", "tasks"))
    tasks = _list("tasks", record["tasks"])
    ids = tuple(checks.text(PlanError, f"tasks[{index}]", task) for index, task in enumerate(tasks))
    return checks.text(PlanError, "drone", record["drone"]), ids


def _unserved(item: Any) -> tuple[str, str]:
    record = checks.keys(PlanError, item, ("task", "reason"))
    return checks.text(PlanError, "task", record["task"]), checks.text(PlanError, "reason", record["reason"])


def _trajectory(item: Any) -> tuple[str, Flight]:
    record = checks.keys(PlanError, item, ("drone", "breakpoints", "coefficients", "visits"))
    breakpoints = _breakpoints(record["breakpoints"])
    coefficients = _coefficients(record["coefficients"], len(breakpoints) - 1)
    visits = checks.objects(PlanError, "visits", record["visits"], _visit)
    return checks.text(PlanError, "drone", record["drone"]), Flight(Curve(breakpoints, coefficients), visits)


def _breakpoints(value: Any) -> FloatArray:
    times = [checks.number(PlanError, f"breakpoints[{i}]", t, least=0.0) for i, t in enumerate(_list("breakpoints", value))]
    if len(times) < 2:
        rule = "a trajectory has a start and an end at least"
        raise PlanError("breakpoints", f"has {len(times)} entries", rule, "leave out drones that never move")
    for i in range(1, len(times)):
        if not times[i] > times[i - 1]:
            rule = f"must be > breakpoints[{i - 1}] = {times[i - 1]:g}"
            raise PlanError(f"breakpoints[{i}]", f"is {times[i]:g}", rule, "put them in order")
    return np.array(times)


def _coefficients(value: Any, num_pieces: int) -> FloatArray:
    pieces = _list("coefficients", value)
    if len(pieces) != num_pieces:
        rule = f"must be {num_pieces}, one fewer than there are breakpoints"
        raise PlanError("coefficients", f"has {len(pieces)} pieces", rule, "give every piece a start and an end")
    rows = [[_axis(f"coefficients[{k}]", piece, axis) for axis in range(3)] for k, piece in enumerate(pieces)]
    result = np.zeros((num_pieces, 3, max(len(terms) for piece in rows for terms in piece)))
    for k, piece in enumerate(rows):
        for axis, terms in enumerate(piece):
            result[k, axis, : len(terms)] = terms
    return result


def _axis(field: str, piece: Any, axis: int) -> list[float]:
    if len(_list(field, piece)) != 3:
        raise PlanError(field, f"has {len(piece)} axes", "must be [x, y, z]", "give one list of terms an axis")
    where = f"{field}[{axis}]"
    terms = [checks.number(PlanError, f"{where}[{n}]", term) for n, term in enumerate(_list(where, piece[axis]))]
    if not 1 <= len(terms) <= LARGEST_DEGREE + 1:
        rule = f"must be of degree 0 to {LARGEST_DEGREE}: 1 to {LARGEST_DEGREE + 1} terms"
        raise PlanError(where, f"has {len(terms)} terms", rule, "lower the degree")
    return terms


def _visit(item: Any) -> Visit:
    record = checks.keys(PlanError, item, ("task", "time"))
    return Visit(checks.text(PlanError, "task", record["task"]), checks.number(PlanError, "time", record["time"], least=0.0))


def _cost(item: Any) -> Cost:
    record = checks.keys(PlanError, item, MEASURES, ("travel_revision",))
    sure = {name: checks.number(PlanError, name, record[name], least=0.0) for name in ("length", "travel", "makespan")}
    claims = {name: None if record[name] is None else checks.number(PlanError, name, record[name]) for name in CLAIMS}
    revision = checks.integer(PlanError, "travel_revision", record.get("travel_revision", FIRST_REVISION), least=FIRST_REVISION)
    return Cost(sure["length"], sure["travel"], claims["lower_bound"], claims["gap"], sure["makespan"], revision)


def _cost_record(cost: Cost) -> dict[str, Any]:
    record = {name: _plain(getattr(cost, name)) for name in MEASURES}
    return record if cost.travel_revision == FIRST_REVISION else record | {"travel_revision": cost.travel_revision}


def _settings(item: Any) -> dict[str, Setting]:
    if not isinstance(item, dict):
        raise PlanError("", f"is {checks.shown(item)}", "must be an object of plain values by name", "put it in braces")
    for name, value in item.items():
        if isinstance(value, (list, dict)):
            rule = "must be a text, a number, true, false or null"
            raise PlanError(name, f"is {checks.shown(value)}", rule, "leave it out")
    return dict(item)


def _timing(item: Any) -> dict[str, float]:
    if not isinstance(item, dict):
        raise PlanError("", f"is {checks.shown(item)}", "must be an object of seconds by stage", "put it in braces")
    return {stage: checks.number(PlanError, stage, seconds, least=0.0) for stage, seconds in item.items()}


def _list(field: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise PlanError(field, f"is {checks.shown(value)}", "must be a list", "put it in brackets")
    return value
