"""A robot without a robot: ARCOS firmware, its line and its faults, in real time."""
