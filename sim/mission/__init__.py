"""What is flown, and what came of it."""
