"""Which drone visits which tasks in which order, and how far that can be from the optimum."""

from flockopt.bundles.bundles import Bound, Bundles

__all__ = ["Bound", "Bundles"]
