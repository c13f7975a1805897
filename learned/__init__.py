"""The learned planners: a teacher trained by reinforcement, its baselines, and a student that draws whole fleets' flights."""
