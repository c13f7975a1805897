"""From a scene to a certified plan, and from a flying plan to the next."""
