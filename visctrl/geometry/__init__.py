"""Pure functions on arrays: the geometry of two and three views."""
