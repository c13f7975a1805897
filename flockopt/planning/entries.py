"""What is compiled of flockopt: what every plan needs, and what only some do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["EVERYTHING", "JUDGING", "PLANNING", "entries_of"]

#: Packages of what `flockopt.certify` calls.
JUDGING = ("flockopt.certificate.proof", "flockopt.geometry")

#: Packages and modules of what a plan by ``classical`` calls that nothing special is asked of.
PLANNING = (
    *JUDGING, "flockopt.travel", "flockopt.bundles.search", "flockopt.bundles.bounds", "flockopt.flights.apart",
    "flockopt.flights.laws.corners", "flockopt.flights.laws.fly_through",
)  # fmt: skip

#: All packages.
EVERYTHING = ("flockopt",)


def entries_of(packages: Sequence[str]) -> dict[str, Any]:
    """What `flockopt.batches.compiled.ENTRIES` holds of some packages and modules, when all modules are loaded that add to it.

    It is empty where numba is told not to compile (NUMBA_DISABLE_JIT).
    """
    import flockopt.bundles.bounds.forest
    import flockopt.bundles.bounds.ng_route
    import flockopt.bundles.exact.cuts
    import flockopt.bundles.exact.tails
    import flockopt.bundles.search.anneal
    import flockopt.certificate.optimum
    import flockopt.certificate.proof
    import flockopt.flights.apart.schedule
    import flockopt.flights.laws.corner_speeds
    import flockopt.flights.laws.corners
    import flockopt.flights.laws.correction
    import flockopt.flights.laws.leg_pieces
    import flockopt.flights.smoothing.tangents
    import flockopt.travel.roadmap  # noqa: F401
    from flockopt.batches.compiled import ENTRIES

    begin = tuple(f"{package}." for package in packages)
    return {name: entry for name, entry in ENTRIES.items() if name.startswith(begin)}
