"""The teacher and its baselines: allocation learned by reinforcement, one decision a drone and step."""
