"""Seeded scene generators: forest, corridor, warehouse, rooms and city; see docs/families.md."""
