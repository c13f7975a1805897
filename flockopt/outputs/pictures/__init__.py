"""Pictures of scenes and plans, and a page that plays the flight."""
