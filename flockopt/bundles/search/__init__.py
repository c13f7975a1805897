"""Ruin-and-recreate search, compiled."""
