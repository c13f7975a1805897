"""The paper's execution planner: voxel grids, and the ways that a fleet may be told to fly."""
