"""Compiled: samples of legs laid out, chosen, and whether they are clear."""
