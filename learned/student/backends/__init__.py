"""What computes the student: torch, or its graphs compiled by OpenVINO."""
