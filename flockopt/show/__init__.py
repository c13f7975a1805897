"""Pictures of scenes and plans, and a page that plays the flight."""

from flockopt.show.drawing import show

__all__ = ["show"]
