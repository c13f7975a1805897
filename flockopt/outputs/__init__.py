"""What becomes of a plan: pictures, and files for real drones."""
