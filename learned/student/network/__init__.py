"""The student's network, part by part."""
