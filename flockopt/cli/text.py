"""What the commands print: tables for people."""

from __future__ import annotations

import io
import math
import os
import sys
from array import array
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from statistics import fmean, median
from typing import TYPE_CHECKING

from flockopt.records.status import Status

if TYPE_CHECKING:
    from flockopt.certificate import Certificate, Clause, Plan
    from flockopt.outputs.devices.export import Export
    from flockopt.planning.plan_row import PlanRow
    from flockopt.scene import Scene

#: How many of the scenes that are not certified are named; their rows name all.
NAMED = 10

__all__ = [
    "RowsReport",
    "certificate_report",
    "emit",
    "export_report",
    "let_go",
    "plan_report",
    "printable",
    "trajectories_report",
]


#: What is told of the rows of certified plans, in words, and the field that holds it.
ROW_NUMBERS = {"cost, m": "cost", "gap": "gap", "makespan, s": "makespan", "planning, s": "seconds"}


def emit(text: str, *, aside: bool = False) -> None:
    """Print to stdout; ``aside``, to stderr, where stdout holds a file. A reader who has left (``| head``) is no error."""
    stream = sys.stderr if aside else sys.stdout
    try:
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        let_go(stream)


def let_go(stream: object) -> None:
    """Have a stream swallow what is left in it: Python flushes it once more when it exits, and would fail again."""
    if isinstance(stream, io.TextIOWrapper):
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def printable(text: str) -> str:
    """The text on one line, with control characters (which a hostile file may hold) written as escapes."""
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Columns as wide as they need; those whose index is in ``right`` are set to the right."""
    lines = [[printable(text) for text in line] for line in (header, *rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        "  ".join(
            text.rjust(width) if column in right else text.ljust(width)
            for column, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def plan_report(scene: Scene, plan: Plan) -> str:
    """Per drone its tasks, metres and seconds; then cost, bound and gap; then the certificate."""
    parts = [_drone_table(scene, plan)] if plan.status != Status.INFEASIBLE else []
    if plan.unserved:
        parts.append(table(("unserved task", "reason"), sorted(plan.unserved.items())))
    if plan.status != Status.INFEASIBLE:
        parts.append(_cost_lines(plan))
    if plan.certificate is not None:
        parts.append(certificate_report(plan.certificate))
    if plan.reason:
        parts.append(printable(f"{plan.status}: {plan.reason}"))
    parts.append(printable(f"{scene.name}, planned in {plan.timing.get('total', 0.0):.2f} s by {plan.planner}"))
    return "\n\n".join(parts)


def _drone_table(scene: Scene, plan: Plan) -> str:
    rows = []
    for drone in scene.drones:
        flight = plan.flights.get(drone.id)
        metres, seconds = (flight.curve.length, flight.curve.end_time) if flight is not None else (0.0, 0.0)
        route = plan.routes.get(drone.id, ())
        rows.append((drone.id, str(len(route)), f"{metres:.2f}", f"{seconds:.2f}", " ".join(route)))
    return table(("drone", "tasks", "metres", "seconds", "in this order"), rows, right=(1, 2, 3))


def _cost_lines(plan: Plan) -> str:
    cost = plan.cost
    bound = "none" if cost.lower_bound is None else f"{cost.lower_bound:.2f} m"
    gap = "none" if cost.gap is None else f"{cost.gap:.2%}"
    if plan.certificate is not None and plan.certificate.bound is not None and plan.certificate.bound.kind == "optimum":
        gap += ": no allocation travels less, and that is proven"
    return "\n".join(
        (
            f"length    {cost.length:.2f} m flown in {cost.makespan:.2f} s",
            f"cost      {cost.travel:.2f} m of travel",
            f"bound     {bound}",
            f"gap       {gap}",
        )
    )


def certificate_report(certificate: Certificate) -> str:
    """One row per clause: does it hold, by how much, and where it is tightest; then the verdict."""
    rows = []
    for clause in certificate.clauses:
        tightest = "; ".join(words for words in (clause.where, clause.detail) if words)
        rows.append((clause.name, "holds" if clause.holds else "FAILS", _margin(clause), tightest))
    return table(("clause", "", "margin", "tightest"), rows, right=(2,)) + "\n\n" + _verdict(certificate)


def trajectories_report(scene: Scene, plan: Plan, rounding: float, certificate: Certificate) -> str:
    """What trajectories were taken for, and the certificate."""
    words = f"{len(plan.flights)} trajectories; each task is served by the drone that is first at it"
    if rounding:
        words += f"; coefficients are known to {rounding:g}: jumps that this explains are let pass"
    return "\n\n".join([words, _drone_table(scene, plan), certificate_report(certificate)])


class RowsReport:
    """What rows of many scenes amount to; only numbers are kept of them."""

    def __init__(self) -> None:
        self._statuses: Counter[Status] = Counter()
        self._numbers: dict[str, array[float]] = {name: array("d") for name in ROW_NUMBERS.values()}
        self._named: list[str] = []

    def add(self, row: PlanRow) -> None:
        """Take a row into account."""
        self._statuses[row.status] += 1
        if not row.certified and len(self._named) < NAMED:
            self._named.append(f"{row.source or row.scene}: {row.status}: {row.reason}")
        if row.certified:
            for name, numbers in self._numbers.items():
                value = row.seconds["total"] if name == "seconds" else getattr(row, name)
                if value is not None:
                    numbers.append(value)

    @property
    def is_certified(self) -> bool:
        """Whether every plan is."""
        return set(self._statuses) <= {Status.CERTIFIED}

    def words(self, path: str) -> str:
        """How many scenes came to what, how their numbers spread, and the first of those that are not certified."""
        counts = [f"{count} {status}" for status, count in sorted(self._statuses.items())]
        parts = [f"{sum(self._statuses.values())} scenes: {', '.join(counts) or 'nothing to plan'}"]
        rows = [(words, *_spread(self._numbers[name])) for words, name in ROW_NUMBERS.items() if self._numbers[name]]
        if rows:
            parts.append(table(("certified plans", "mean", "least", "median", "most"), rows, right=(1, 2, 3, 4)))
        others = sum(self._statuses.values()) - self._statuses[Status.CERTIFIED] - len(self._named)
        parts += ["\n".join(map(printable, [*self._named, *([f"and {others} more"] if others else [])]))] if self._named else []
        return "\n\n".join([*parts, printable(f"a row each in {path}")])


def _spread(numbers: Sequence[float]) -> list[str]:
    return [f"{value:.4g}" for value in (fmean(numbers), min(numbers), median(numbers), max(numbers))]


def export_report(plan: Plan, path: str, outcome: Export) -> str:
    """What was written where, or what does not fit; and a warning where the plan is not certified."""
    if outcome.misfits:
        lines = [*outcome.misfits, "nothing was written"]
    else:
        lines = [f"{path}: {', '.join(outcome.files)}"]
        if plan.status != Status.CERTIFIED:
            lines.append(f"warning: the plan is {plan.status}; do not fly it before `flockopt verify` holds")
    return "\n".join(printable(line) for line in lines)


def _verdict(certificate: Certificate) -> str:
    if certificate.certified:
        return "certified: every clause holds"
    return f"not certified: {', '.join(clause.name for clause in certificate.failed)} failed"


def _margin(clause: Clause) -> str:
    """What is left before a clause fails: fractions in per cent; nothing to check has no margin."""
    if not math.isfinite(clause.margin):
        return "-"
    return f"{clause.margin:.1%}" if clause.unit == "fraction" else f"{clause.margin:.4g} {clause.unit}"
