"""Planners whose networks answer many scenes at once: one proposes for a single scene as for the only one of many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

from flockopt.planning.planners import Planner, Proposal, Request

__all__ = ["planner_of_many"]

ProposeMany: TypeAlias = Callable[[Sequence[Request]], list[Proposal]]


def planner_of_many(propose: ProposeMany, name: str, **keywords: Any) -> Planner:
    """A planner that can propose for many scenes at once.

    Args:
        propose: From at least one request to as many proposals; picklable.
        name: What plan files call it.
        keywords: As of `Planner`.
    """
    return Planner(partial(_one, propose), name, propose_many=partial(_many, propose), **keywords)


def _one(propose: ProposeMany, request: Request) -> Proposal:
    (proposal,) = propose([request])
    return proposal


def _many(propose: ProposeMany, requests: Sequence[Request]) -> list[Proposal]:
    """Proposals by one thread: where many scenes are planned, others are planned on the other cores."""
    from learned.networks.threads import one_thread

    with one_thread():
        return propose(requests)
