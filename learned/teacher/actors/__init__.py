"""The policies and the central critic."""
