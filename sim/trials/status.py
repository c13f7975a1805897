"""How far a flight of a batch came: one closed set of statuses, each with what it means and what to do about it."""

from __future__ import annotations

from enum import StrEnum

__all__ = ["TrialStatus"]


class TrialStatus(StrEnum):
    """The status of a flight in a batch: that of its plan, or that it came to nothing.

    Members are strings, so that tables and journals keep their words.

    Attributes:
        text: What it means.
        mend: What to do about it; empty where nothing is to be done.
    """

    text: str
    mend: str

    CERTIFIED = "certified", "its plan was certified, and flown", ""
    UNCERTIFIED = (
        "uncertified", "its plan fails a clause of the certificate", "try another planner or margin, or fly it with --force",
    )  # fmt: skip
    INFEASIBLE = "infeasible", "some task cannot be served", "ask for more drones or fewer tasks"
    ERROR = "error", "it was broken off", "mend what is named, and fly it again in another folder"

    def __new__(cls, word: str, text: str = "", mend: str = "") -> TrialStatus:
        """The member that ``word`` stands for."""
        member = str.__new__(cls, word)
        member._value_ = word
        member.text, member.mend = text, mend
        return member
