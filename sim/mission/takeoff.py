"""Which plans may take off: those that the judge certifies anew, whatever they say of themselves."""

from __future__ import annotations

from flockopt.certificate import Plan
from flockopt.certificate.judge import certify
from flockopt.errors import PlanError
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.travel import Travel

__all__ = ["require_certified"]


def require_certified(scene: Scene, plan: Plan, travel: Travel | None) -> None:
    """Refuse a plan that does not hold.

    Args:
        scene: The scene it is for.
        plan: The plan.
        travel: The scene's travel, if it is at hand; the judge computes it otherwise.

    Raises:
        PlanError: Naming the clauses that fail.
    """
    mend = "plan the scene again, or fly it all the same with force=True (--force)"
    if plan.status == Status.INFEASIBLE:
        raise PlanError("status", f"is 'infeasible' ({plan.reason})", "only certified plans are flown", mend)
    failed = [clause for clause in certify(scene, plan, travel=travel).clauses if not clause.holds]
    if failed:
        words = f"fails ({', '.join(clause.name for clause in failed)}: {failed[0].detail})"
        raise PlanError("certificate", words, "only certified plans are flown", mend)
