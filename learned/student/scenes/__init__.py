"""Scenes and demonstrations as tensors, with masks."""
