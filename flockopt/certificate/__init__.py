"""The plan file, and the judge of what it claims."""

from flockopt.certificate.certificate import Certificate, Clause
from flockopt.certificate.plan_file import Cost, Plan

__all__ = ["Certificate", "Clause", "Cost", "Plan"]
