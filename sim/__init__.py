"""Flying plans in PyBullet: the world, the drones and their controllers, execution and its evaluation."""
