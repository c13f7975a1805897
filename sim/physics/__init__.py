"""What moves: drones, their control, PyBullet's world."""
