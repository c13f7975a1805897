"""Seeded scene generators: forest, corridor, warehouse, rooms and city; see docs/families.md."""

from flockopt.families.generate import generate
from flockopt.families.layouts import FAMILIES
from flockopt.families.settings import FamilySettings

__all__ = ["FAMILIES", "FamilySettings", "generate"]
