"""What the live page says in words, as Markdown."""

from __future__ import annotations

import math

from flockopt.records.status import Status
from sim.live.view import View

__all__ = ["log_text", "status_text", "verdict_text"]

#: Clauses whose margins are worth watching.
WATCHED = ("clearance", "separation")

#: Lines of the log that are shown, the latest first.
LOG_LINES = 12


def status_text(view: View) -> str:
    """Time, tasks by state, contacts."""
    counts = {state: sum(task.state == state for task in view.tasks) for state in ("served", "open", "left out")}
    tasks = ", ".join(f"{count} {state}" for state, count in counts.items())
    drones = f"{len(view.drones)} in the air" + (f", {len(view.lost)} lost" if view.lost else "")
    return f"**{view.now_s:.1f} s**, {view.state}\n\ntasks: {tasks}\n\ndrones: {drones}\n\ncontacts: {view.contacts}"


def verdict_text(view: View) -> str:
    """What is flown and what the judge says of it, and the last answer with its latency."""
    lines = [f"flown: **{view.plan.status}**" + _margins(view)]
    if math.isfinite(view.swap_s):
        lines.append(f"a new certified plan is swapped in in {max(view.swap_s, 0.0):.1f} s")
    if view.answer is not None:
        answer, verdict = view.answer, view.answer.plan.status
        kept = "" if verdict == Status.CERTIFIED else "; refused, the old plan is flown on"
        lines.append(f"last answer: {1000.0 * answer.seconds:.0f} ms, {answer.strategy} bundles, **{verdict}**{kept}")
    lines += [f"{task.id} is left out: {task.reason}" for task in view.tasks if task.state == "left out"]
    return "\n\n".join(lines)


def _margins(view: View) -> str:
    """By how much the watched clauses of the certificate hold."""
    certificate = view.plan.certificate
    clauses = () if certificate is None else certificate.clauses
    watched = [clause for clause in clauses if clause.name in WATCHED and math.isfinite(clause.margin)]
    words = ", ".join(f"{clause.name} {clause.margin:.3g} {clause.unit}" for clause in watched)
    return f", to spare: {words}" if words else ""


def log_text(view: View) -> str:
    """The latest lines of the log, the latest first."""
    return "\n".join(f"    {line}" for line in reversed(view.log[-LOG_LINES:]))
