"""How far an answer goes: one closed set of statuses, each with what it means and what to do about it."""

from __future__ import annotations

from enum import StrEnum

__all__ = ["Status"]


class Status(StrEnum):
    """The status of bundles, of a plan, or of a scene among many.

    Members are strings, so that ``plan.status == "certified"`` holds and files keep their words.

    Attributes:
        text: What it means.
        mend: What to do where it is not what was hoped for; empty where nothing is.
    """

    text: str
    mend: str

    OPTIMAL = "optimal", "no allocation travels less, and that is proven", ""
    FEASIBLE = "feasible", "every task is allocated; nothing is proven of the travel", ""
    INCOMPLETE = (
        "incomplete", "some task is left over, though nothing proves that it must be",
        "give it more time or try the planner exact",
    )  # fmt: skip
    INFEASIBLE = "infeasible", "some task cannot be served", "read the reason; add capacity, range or room, or drop the task"
    CERTIFIED = "certified", "every clause of the certificate holds", ""
    UNCERTIFIED = (
        "uncertified", "some clause of the certificate fails", "read which, and where; do not fly the plan as it is",
    )  # fmt: skip

    ERROR = "error", "it was broken off, and there is no answer", "read the reason, mend what it names, and ask again"

    def __new__(cls, word: str, text: str = "", mend: str = "") -> Status:
        """A member of this word, with its text and its mend."""
        member = str.__new__(cls, word)
        member._value_ = word
        member.text, member.mend = text, mend
        return member


#: What bundles may be, and what a plan may be.
BUNDLE_STATUSES = (Status.FEASIBLE, Status.OPTIMAL, Status.INCOMPLETE, Status.INFEASIBLE)
PLAN_STATUSES = (Status.CERTIFIED, Status.UNCERTIFIED, Status.INFEASIBLE)
