"""The network that smooths timed flights."""
