"""Paths, the robot's footprint among obstacles, lattice planning and avoidance."""
