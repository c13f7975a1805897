"""Allocation: which drone visits which tasks in which order, and how far that can be from the optimum."""

from flockopt.allocate.refine import METHODS, refine_bundles

__all__ = ["METHODS", "refine_bundles"]
