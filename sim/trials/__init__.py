"""Batches of flights, and what they amount to."""
