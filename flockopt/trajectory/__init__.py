"""Trajectories: from bundles to smooth flights that keep clear of obstacles and of each other."""
