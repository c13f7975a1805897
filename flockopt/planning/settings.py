"""What steers a plan, checked once: one record for planning, replanning, flights in simulation and benchmarks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flockopt.bundles.bundles import BOUND_EFFORTS
from flockopt.errors import SettingsError
from flockopt.planning.planners import ANY_ANGLE, Planner
from flockopt.records import checks

__all__ = ["PlanSettings"]


@dataclass(frozen=True)
class PlanSettings:
    """How to plan.

    Attributes:
        planner: Who proposes: a `Planner`, the name of one (`flockopt.planning.planners.planner_names`), or None for the ready
            one of the highest rank.
        time_limit_s: Seconds for the whole plan, once flockopt's compiled code is loaded; None lets the planner stop by its own
            measure, which makes the answer the same on every machine.
        seed: For everything random.
        bound: How hard to prove a lower bound, one of ``fast``, ``tight``, ``exact``: see
            `flockopt.bundles.bounds.bounds.lower_bound`. A planner that proves one itself (``exact``) is not asked again.
        smoothing: Whether to smooth the flights before they are kept apart: the fleet is done earlier, with less jerk, for
            tens of milliseconds a drone (`flockopt.flights.smoothing.smooth`).
        tracking_margin_m: How far drones may stray from the plan, metres: flights keep that much more clearance, and twice
            that much more separation, as far as the scene leaves the room (`flockopt.planning.margins`). The certificate is
            for the scene as it is.
        paths: What drones fly along: ``any-angle``, the shortest paths, or others that the planner knows.
        backend: What computes a planner's networks, such as ``torch`` or ``openvino``; None for the best that is installed.

    Raises:
        SettingsError: Naming the field, the value, the rule and the mend.
    """

    planner: Planner | str | None = None
    time_limit_s: float | None = None
    seed: int = 0
    bound: str = "tight"
    smoothing: bool = False
    tracking_margin_m: float = 0.0
    paths: str = ANY_ANGLE
    backend: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.planner, Planner | None):
            checks.text(SettingsError, "planner", self.planner)
        if self.time_limit_s is not None:
            mend = "give it seconds, or None for no limit"
            checks.store(self, checks.number, SettingsError, "time_limit_s", above=0.0, mend=mend)
        checks.store(self, checks.integer, SettingsError, "seed", least=0)
        checks.store(self, checks.choice, SettingsError, "bound", known=BOUND_EFFORTS)
        checks.store(self, checks.flag, SettingsError, "smoothing")
        checks.store(self, checks.number, SettingsError, "tracking_margin_m", least=0.0)
        checks.text(SettingsError, "paths", self.paths)
        if self.backend is not None:
            checks.text(SettingsError, "backend", self.backend)

    @classmethod
    def of(cls, settings: PlanSettings | None, keywords: Mapping[str, Any]) -> PlanSettings:
        """The settings with some of them changed; a keyword that is none is refused, and the nearest one named."""
        names = [field.name for field in dataclasses.fields(cls)]
        checks.keys(SettingsError, dict(keywords), (), names)
        return dataclasses.replace(settings or cls(), **keywords)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for a plan file; the planner is left out, whom the plan names itself."""
        record = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        del record["planner"]
        return record
