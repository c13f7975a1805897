"""What the judge says of a plan: clauses with their margins, and what proves the bound."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from flockopt.bundles import Bound
from flockopt.errors import PlanError
from flockopt.records import checks
from flockopt.scene import Point

__all__ = ["CLAUSES", "FLYABILITY", "Certificate", "Clause"]

#: Every clause, in the order in which a certificate lists them (docs/certificate.md).
CLAUSES = (
    "coverage", "capacity", "start", "visits", "continuity", "limits", "bounds", "clearance", "separation", "bound",
)  # fmt: skip

#: The clause that comes last where the scene says what a drone's rotors can do.
FLYABILITY = "flyability"

#: Which ids and words a clause may name.
WORDS = ("drone", "other_drone", "task", "obstacle", "detail")


@dataclass(frozen=True)
class Clause:
    """One thing that must hold of a plan, and where it is tightest.

    Attributes:
        name: One of `CLAUSES`, or `FLYABILITY`.
        holds: Whether it does.
        margin: What is left before it fails, negative where it fails, in ``unit``; infinite where there is nothing
            to check.
        unit: ``"m"``, ``"tasks"``, or ``"fraction"`` of the limit or of the tolerance.
        time: Seconds, of the tightest moment.
        place: Metres, where the drone is then.
        drone: Id of the drone.
        other_drone: Id of the drone it comes near to.
        task: Id of the task.
        obstacle: Id of the obstacle.
        detail: Why it fails, or what to know where it holds.
    """

    name: str
    holds: bool
    margin: float
    unit: str
    time: float | None = None
    place: Point | None = None
    drone: str | None = None
    other_drone: str | None = None
    task: str | None = None
    obstacle: str | None = None
    detail: str = ""

    def __post_init__(self) -> None:
        """Numbers become Python's own, which files can hold: what is measured comes as numpy's where numba is switched off."""
        object.__setattr__(self, "holds", bool(self.holds))
        object.__setattr__(self, "margin", float(self.margin))
        object.__setattr__(self, "time", None if self.time is None else float(self.time))
        object.__setattr__(self, "place", None if self.place is None else tuple(map(float, self.place)))

    @property
    def where(self) -> str:
        """The tightest place in words; empty where there is none."""
        words = [f"{name.replace('_', ' ')} {getattr(self, name)}" for name in WORDS[:4] if getattr(self, name) is not None]
        if self.time is not None:
            words.append(f"t = {self.time:.3f} s")
        if self.place is not None:
            words.append("({:.3f}, {:.3f}, {:.3f})".format(*self.place))
        return ", ".join(words)

    def to_dict(self) -> dict[str, Any]:
        """Its JSON object: an infinite margin is null, what is not known is left out."""
        margin = self.margin if math.isfinite(self.margin) else None
        record: dict[str, Any] = {"name": self.name, "holds": self.holds, "margin": margin, "unit": self.unit}
        if self.time is not None:
            record["time"] = self.time
        if self.place is not None:
            record["place"] = list(self.place)
        return record | {word: getattr(self, word) for word in WORDS if getattr(self, word)}

    @classmethod
    def from_dict(cls, item: Any) -> Clause:
        """A clause from its JSON object, read strictly."""
        record = dict(checks.keys(PlanError, item, ("name", "holds", "margin", "unit"), ("time", "place", *WORDS)))
        if record["name"] not in (*CLAUSES, FLYABILITY):
            rule = f"must be one of {', '.join((*CLAUSES, FLYABILITY))}"
            raise PlanError("name", f"is {checks.shown(record['name'])}", rule, "correct its spelling")
        if not isinstance(record["holds"], bool):
            raise PlanError("holds", f"is {checks.shown(record['holds'])}", "must be true or false", "judge the plan anew")
        margin = record["margin"]
        record["margin"] = math.inf if margin is None else checks.number(PlanError, "margin", margin)
        for word in ("unit", *WORDS):
            if word in record:
                checks.text(PlanError, word, record[word])
        if "time" in record:
            record["time"] = checks.number(PlanError, "time", record["time"])
        if "place" in record:
            record["place"] = checks.point(PlanError, "place", record["place"])
        return cls(**record)


@dataclass(frozen=True)
class Certificate:
    """The judgement of a plan.

    Attributes:
        clauses: One of each, in the order of `CLAUSES`, and `FLYABILITY` where it is judged.
        bound: What proves the lower bound, None where none is claimed.
    """

    clauses: tuple[Clause, ...]
    bound: Bound | None = None

    @property
    def certified(self) -> bool:
        """Whether every clause holds."""
        return all(clause.holds for clause in self.clauses)

    @property
    def failed(self) -> tuple[Clause, ...]:
        """The clauses that do not hold."""
        return tuple(clause for clause in self.clauses if not clause.holds)

    def __getitem__(self, name: str) -> Clause:
        return {clause.name: clause for clause in self.clauses}[name]

    def to_dict(self) -> dict[str, Any]:
        """Its JSON object."""
        bound = None
        if self.bound is not None:
            bound = {"kind": self.bound.kind, "value": self.bound.value, "dual": [float(value) for value in self.bound.dual]}
        return {"clauses": [clause.to_dict() for clause in self.clauses], "bound": bound}

    @classmethod
    def from_dict(cls, item: Any) -> Certificate:
        """A certificate from its JSON object, read strictly. It is a claim: only `flockopt.certify` judges."""
        record = checks.keys(PlanError, item, ("clauses", "bound"))
        clauses = checks.objects(PlanError, "clauses", record["clauses"], Clause.from_dict)
        names = tuple(clause.name for clause in clauses)
        if names not in (CLAUSES, (*CLAUSES, FLYABILITY)):
            rule = f"must be {', '.join(CLAUSES)}, in this order, then {FLYABILITY} where it is judged"
            raise PlanError("clauses", f"are {checks.shown(names)}", rule, "judge the plan anew")
        try:
            return cls(clauses, None if record["bound"] is None else _bound(record["bound"]))
        except PlanError as fault:
            raise fault.within("bound") from None


def _bound(item: Any) -> Bound:
    record = checks.keys(PlanError, item, ("kind", "value", "dual"))
    dual = record["dual"]
    if not isinstance(dual, (list, tuple)):
        raise PlanError("dual", f"is {checks.shown(dual)}", "must be a list of numbers", "put it in brackets")
    values = [checks.number(PlanError, f"dual[{index}]", value) for index, value in enumerate(dual)]
    kind = checks.text(PlanError, "kind", record["kind"])
    return Bound(kind, checks.number(PlanError, "value", record["value"]), np.array(values, dtype=np.float64))
