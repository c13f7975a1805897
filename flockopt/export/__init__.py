"""Plans as the files that real drones fly from."""

from flockopt.export.devices import Export, export

__all__ = ["Export", "export"]
