"""A plan as a row of a study: what came of one scene among many, in plain values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from flockopt.certificate import Plan
from flockopt.records.status import Status
from flockopt.scene import Scene

__all__ = ["COLUMNS", "FIELDS", "STAGES", "PlanRow"]

#: Stages whose seconds have columns in tables; records have those of the planner too.
STAGES = (
    "travel", "allocate", "bound", "room", "decode", "smooth", "deconflict", "certify", "fallback", "total",
)  # fmt: skip


@dataclass(frozen=True)
class PlanRow:
    """What came of one scene. Rows are equal where all but their seconds are.

    Attributes:
        scene: The scene's name; that of its file where it could not be read.
        source: The file that it was read from; empty where it was handed over.
        digest: `flockopt.Scene.sha256`; empty where it could not be read.
        drones: How many.
        tasks: How many.
        planner: Who proposed.
        seed: For everything random.
        status: That of the plan, or ``error`` where there is none.
        certified: Whether every clause of the plan's certificate holds.
        unserved: How many tasks no drone serves; None where there is no answer.
        cost: Metres of travel; None, as the four after it, where there is no plan to judge.
        bound: Metres, a proven lower bound on that; None where none is known.
        gap: ``(cost - bound) / bound``; None where there is no bound.
        length: Metres flown.
        makespan: Seconds until the last drone has finished.
        reason: Why there is no certified plan: what it says of itself, clauses that fail, the error; empty where there is one.
        plan: The plan's file within the folder of the run; empty where none is kept.
        seconds: What planning took, by stage, and the ``total``.
    """

    scene: str
    source: str
    digest: str
    drones: int
    tasks: int
    planner: str
    seed: int
    status: Status
    certified: bool = False
    unserved: int | None = None
    cost: float | None = None
    bound: float | None = None
    gap: float | None = None
    length: float | None = None
    makespan: float | None = None
    reason: str = ""
    plan: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "status", Status(self.status))
        object.__setattr__(self, "seconds", MappingProxyType(dict(self.seconds)))

    def __reduce__(self) -> tuple[Any, ...]:
        """A view of seconds cannot be pickled; the record can."""
        return PlanRow.from_dict, (self.to_dict(),)

    @classmethod
    def of(cls, scene: Scene, made: Plan, seed: int, plan: str = "") -> PlanRow:
        """The row of a plan."""
        row = cls.broken(scene, made.planner, seed, "")
        row = dataclasses.replace(
            row, status=made.status, certified=made.status == Status.CERTIFIED, unserved=len(made.unserved), plan=plan,
            seconds=made.timing,
        )  # fmt: skip
        if made.certificate is None:
            return dataclasses.replace(row, reason=made.reason)
        fails = ", ".join(clause.name for clause in made.certificate.failed)
        reasons = (made.reason, f"the certificate fails: {fails}" if fails else "")
        cost = made.cost
        return dataclasses.replace(
            row, cost=cost.travel, bound=cost.lower_bound, gap=cost.gap, length=cost.length, makespan=cost.makespan,
            reason="; ".join(filter(None, reasons)),
        )  # fmt: skip

    @classmethod
    def broken(cls, scene: Scene, planner: str, seed: int, reason: str) -> PlanRow:
        """The row of a scene that there is no answer for."""
        return cls(scene.name, "", scene.sha256, scene.num_drones, scene.num_tasks, planner, seed, Status.ERROR, reason=reason)

    @classmethod
    def unread(cls, source: str, name: str, planner: str, seed: int, reason: str) -> PlanRow:
        """The row of a scene file that cannot be read."""
        return cls(name, source, "", 0, 0, planner, seed, Status.ERROR, reason=reason)

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> PlanRow:
        """A row from its JSON object."""
        return cls(**record)

    def to_dict(self) -> dict[str, Any]:
        """The row as a JSON object."""
        record = {name: getattr(self, name) for name in FIELDS}
        return record | {"status": str(self.status), "seconds": dict(self.seconds)}

    def cells(self) -> dict[str, Any]:
        """The row as cells of a table, by `COLUMNS`."""
        seconds = {f"{stage}_s": self.seconds.get(stage) for stage in STAGES}
        return self.to_dict() | seconds


#: Names of a row's fields, and columns of a table of rows.
FIELDS = tuple(one.name for one in dataclasses.fields(PlanRow))
COLUMNS = (*FIELDS[:-1], *(f"{stage}_s" for stage in STAGES))
