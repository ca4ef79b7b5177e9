"""Obstacle providers: what tells a controller of what stands in the way."""
