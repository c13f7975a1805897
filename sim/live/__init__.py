"""The live playground: a page on which tasks and drones come and go."""
